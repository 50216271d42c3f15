"""The variants of the paper's tables: their settings, and the stage whose scene is evaluated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from cleargs.errors import InputError, did_you_mean


@dataclass(frozen=True)
class Variant:
    """One way to make a scene from a capture; `equal_work` sets its training steps."""

    name: str
    label: str
    """Name in tables."""
    stage: str
    """Stage whose ``scene.ply`` is evaluated."""
    overrides: tuple[str, ...] = ()
    """Settings that differ from the recipe, in the form of ``--set``."""
    workflow: str | None = None
    """Recipe for all stages except ingest; None for that of the comparison."""


_PAPER_RVA = ("rva.active_share=0",)
"""Suppressed frames are reactivated only to fill an empty bin of the trajectory, as in the paper."""
_WEIGHT_ONE = (
    "rva.strong_base=1",
    "rva.strong_gain=0",
    "rva.attenuated_base=1",
    "rva.attenuated_gain=0",
    "rva.reactivated_weight=1",
)
"""Every active frame has weight 1."""

_STILL_SHUTTER = ("ingest.rolling_shutter=false",)
"""Cameras are fitted as if all rows of a frame were exposed at once. A training that compares frames with
sharp renders would lose with cameras that have a readout, because it does not render the readout."""
_PLAIN_G0 = ("g0.formation.enabled=false", *_STILL_SHUTTER)
"""Frame images are compared with the sharp render, without image formation."""

VARIANTS: tuple[Variant, ...] = (
    Variant("all-view", "all-view G0", "g0", ("rva.enabled=false", *_PLAIN_G0)),
    Variant("drop-blurry", "drop-blurry G0", "g0", ("rva.weighting=binary", *_PLAIN_G0)),
    Variant("rva-paper", "RVA G0 of the paper", "g0", (*_PAPER_RVA, *_PLAIN_G0)),
    Variant(
        "rva-no-coverage",
        "RVA G0 of the paper w/o coverage",
        "g0",
        (*_PAPER_RVA, *_PLAIN_G0, "rva.coverage=false"),
    ),
    Variant(
        "rva-binary", "RVA G0 of the paper, weights 0 and 1", "g0", (*_PAPER_RVA, *_PLAIN_G0, *_WEIGHT_ONE)
    ),
    Variant("rva", "RVA G0", "g0", _PLAIN_G0),
    Variant("formation", "RVA G0 with formation", "g0"),
    Variant("all-view-formation", "all-view G0 with formation", "g0", ("rva.enabled=false",)),
    Variant("no-formation", "ClearGS w/o formation", "consolidate", _PLAIN_G0),
    Variant(
        "no-repairs",
        "ClearGS w/o repairs",
        "consolidate",
        ("rivr.distil.pseudo_share=0", "consolidate.distil.pseudo_share=0"),
    ),
    Variant("rivr-no-observation", "ClearGS w/o Obs.", "consolidate", ("rivr.use_observation=false",)),
    Variant("rivr", "ClearGS w/o consolidation", "rivr"),
    Variant("full", "ClearGS", "consolidate"),
    Variant("paper-open", "paper's method, open models", "consolidate", _STILL_SHUTTER, "paper-open"),
    Variant(
        "no-fused",
        "paper's method w/o F_t",
        "consolidate",
        ("rivr.candidates=[]", *_STILL_SHUTTER),
        "paper-open",
    ),
)
"""Variants from the simplest to the whole method, then those of the paper's recipe. Stages that have equal
settings are shared. All variants have the same frames, and the same held-out ones."""

BASELINES = ("all-view", "drop-blurry")
"""Variants that are subtracted from the others in tables of differences."""

WHOLE = "full"
"""The whole method."""

QUESTIONS: tuple[tuple[str, str, str], ...] = (
    ("the whole method, against all-view training", WHOLE, "all-view"),
    ("the whole method, against dropping blurry frames", WHOLE, "drop-blurry"),
    ("the whole method, against the paper's with open models", WHOLE, "paper-open"),
    ("only image formation, against RVA without it", "formation", "rva"),
    ("image formation in the whole method", WHOLE, "no-formation"),
    ("repairs and consolidation, against formation with equal steps", WHOLE, "formation"),
    ("RVA's weights under formation", "formation", "all-view-formation"),
    ("RVA, against all-view training", "rva", "all-view"),
    ("RIVR and consolidation, against RVA trained as long", WHOLE, "rva"),
    ("repairs, against the same distillation without them", WHOLE, "no-repairs"),
    ("consolidation, against as many steps of RIVR", WHOLE, "rivr"),
    ("the frame image before the expert, against the render", WHOLE, "rivr-no-observation"),
    ("coverage compensation", "rva-paper", "rva-no-coverage"),
    ("graded weights, against binary ones of the same frames", "rva-paper", "rva-binary"),
    ("the fused candidate", "paper-open", "no-fused"),
)
"""Questions that the evidence answers: (text, variant, variant that is subtracted)."""


def find_variants(names: Sequence[str]) -> tuple[Variant, ...]:
    """Return the named variants in the order of `VARIANTS`, or all if ``names`` is empty.

    Raises:
        InputError: A name is unknown.
    """
    known = [variant.name for variant in VARIANTS]
    for name in names:
        if name not in known:
            raise InputError(
                f"no variant is called {name!r}",
                hint=did_you_mean(name, known, f"choose among {', '.join(known)}"),
            )
    return tuple(variant for variant in VARIANTS if not names or variant.name in names)
