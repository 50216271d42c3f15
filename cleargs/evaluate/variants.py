"""The variants that the paper's tables compare: which settings make each, and whose scene is judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches

from cleargs.errors import InputError


@dataclass(frozen=True)
class Variant:
    """One way to make a scene from a capture."""

    name: str
    label: str
    """As the tables call it."""
    stage: str
    """Whose ``scene.ply`` is judged."""
    overrides: tuple[str, ...] = ()
    """Settings that differ from the run's recipe, as ``--set`` takes them."""


VARIANTS: tuple[Variant, ...] = (
    Variant("all-view", "all-view G0", "g0", ("rva.enabled=false",)),
    Variant("drop-blurry", "drop-blurry G0", "g0", ("rva.weighting=binary",)),
    Variant("rva-no-coverage", "RVA G0 without coverage", "g0", ("rva.coverage=false",)),
    Variant("rva", "RVA G0", "g0"),
    Variant(
        "rivr-no-observation", "RIVR without observation", "consolidate", ("rivr.use_observation=false",)
    ),
    Variant("rivr-as-is", "RIVR of frames with their motion", "consolidate", ("rivr.undo_motion=false",)),
    Variant("rivr-fused", "RIVR with fused", "consolidate", ("rivr.use_fused=true",)),
    Variant("rivr", "ClearGS before consolidation", "rivr"),
    Variant("full", "ClearGS", "consolidate"),
)
"""From the plainest to the whole method. Those of equal settings share all stages; all share the ingest."""

BASELINES = ("all-view", "drop-blurry")
"""What the others are measured against."""


def find_variants(names: Sequence[str]) -> tuple[Variant, ...]:
    """The variants of these names in the order of `VARIANTS`; all of them for none.

    Raises InputError for an unknown name.
    """
    known = [variant.name for variant in VARIANTS]
    for name in names:
        if name not in known:
            near = get_close_matches(name, known, n=1)
            raise InputError(
                f"no variant is called {name!r}",
                hint=f"did you mean {near[0]}?" if near else f"choose among {', '.join(known)}",
            )
    return tuple(variant for variant in VARIANTS if not names or variant.name in names)
