"""What RIVR and the consolidation share: the settings of a training that goes on with a scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from cleargs.base_model import Inherited, Settings
from cleargs.pipeline.stage import Device
from cleargs.plugins import installed_version
from cleargs.splat.config import TrainConfig, steps_from_frames

G0_END, ROUNDS_END = 16 / 19, 18 / 19
"""Where in the schedule of the whole method the first scene is done, and where RIVR's rounds are."""

MAX_ROUNDS = 16
"""Most rounds of RIVR."""

TRAINED = ("scene.ply", "exposure.parquet", "formation.parquet", "state.safetensors")
"""Outputs of a training from which the next one goes on."""

REPAIR_LIBRARIES = (
    "torch",
    "numba",
    "numpy",
    "OpenImageIO",
    "opencv-contrib-python-headless",
    "pyarrow",
    "safetensors",
)

_GROWTH = (
    *("coarse_share", "coarse_factor", "budget", "max_budget", "growth", "refine_every", "refine_start"),
    *("refine_stop", "min_opacity", "noise", "strategy", "adaptive", "sh_every"),
)
"""Settings of the earlier trainings that had no effect on the later ones."""


def other_libraries(device: Device) -> Mapping[str, str]:
    """What else computes on ``device`` in RIVR and in the consolidation."""
    from cleargs.models.onnx import runtime_version

    kernels = {"triton": installed_version("triton")} if device == "cuda" else {}
    return {"onnxruntime": runtime_version(device), **kernels}


class DistilConfig(Settings):
    """Joint distillation of raw frames and repairs. Whatever is not here is as [g0] has it."""

    RETIRED: ClassVar[Mapping[str, Any]] = {
        **{name: Inherited("g0") for name in (*TrainConfig.model_fields, *TrainConfig.__class_vars__)},
        **{name: Inherited("g0", strictly=False) for name in _GROWTH},
        "opacity_reg": 0.0,
        "scale_reg": 0.0,
    }

    steps: int | None = Field(
        None,
        ge=1,
        le=1_000_000,
        description="optimisation steps, one view each; unset = a sixteenth of a first scene's. What this "
        "table does not name is as in [g0]",
    )
    begin: float = Field(0.0, ge=0, lt=1, description="share of the schedule that lies behind when it begins")
    end: float = Field(1.0, gt=0, le=1, description="share of the schedule that lies behind when it ends")
    densify: bool = Field(False, description="change the number and places of the Gaussians")
    pseudo_share: Annotated[float, Field(ge=0, le=1)] | Literal["even"] = Field(
        0.7,
        description="share of the steps that draw a repaired view; even: the repaired views' share of all "
        "views, so that each is drawn as often as any raw one",
    )
    pseudo_weight: float = Field(0.5, ge=0, description="factor on the loss of a repaired view")

    def applied_to(self, g0: TrainConfig, frames: int) -> TrainConfig:
        """The settings of a training on so many active frames, where the first scene has ``g0``.

        What pulls opacities and scales down, so that Gaussians die and are placed again, is off.
        """
        share = (1.0 - ROUNDS_END) / G0_END
        inherited = {name: getattr(g0, name) for name in TrainConfig.model_fields}
        own = {
            "steps": self.steps or max(1, round(share * steps_from_frames(frames, g0.quality))),
            "begin": self.begin,
            "end": self.end,
            "densify": self.densify,
            "opacity_reg": 0.0,
            "scale_reg": 0.0,
        }
        return TrainConfig(**{**inherited, **own})
