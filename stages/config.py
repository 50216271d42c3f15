"""Settings of the stages that train: of G0, and those that rivr and consolidate share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from cleargs.base_model import FrozenModel
from cleargs.plugins import installed_version
from cleargs.splat.config import OFF, TrainConfig, steps_from_frames
from cleargs.types import Device

G0_END, ROUNDS_END = 16 / 19, 18 / 19
"""Positions, from 0 to 1, in the schedule of all trainings: the ends of G0 and of RIVR's rounds."""

MAX_ROUNDS = 16
"""Maximum number of RIVR's rounds."""

REPAIR_LIBRARIES = (
    "torch",
    "numba",
    "numpy",
    "OpenImageIO",
    "opencv-contrib-python-headless",
    "pyarrow",
    "safetensors",
)


def other_libraries(device: Device, config: object) -> Mapping[str, str]:
    """Return the versions of the other libraries that compute on ``device`` in rivr and consolidate."""
    from cleargs.models.onnx import runtime_version

    kernels = {"triton": installed_version("triton")} if device == "cuda" else {}
    return {"onnxruntime": runtime_version(device), **kernels}


class G0Config(TrainConfig):
    """The first scene, from the sparse points and the frames that RVA keeps."""

    end: float = Field(
        G0_END,
        gt=0,
        le=1,
        description="end of this training in the schedule, as a fraction; RIVR and the consolidation "
        "continue from there. 1: for a scene that no other training continues",
    )
    sh_degree: int | None = Field(
        None, ge=0, le=3, description="largest SH degree; unset = from the number of active frames"
    )
    exposure: Literal["auto", "on", "off"] = Field(
        "auto",
        description="one colour affine per frame; auto = on if the brightness of the frames, measured at "
        "the sparse points, spreads by more than 5 %, or a colour channel without it by more than 2.5 %",
    )
    antialias: bool = Field(False, description="compensate the opacity of sub-pixel splats (Mip-Splatting)")
    min_points: int = Field(
        10_000,
        ge=1,
        le=5_000_000,
        description="fewest Gaussians to start from, within the budget; points are added to reach it",
    )

    exposure_threshold: ClassVar[float] = 0.05
    """``auto`` is on if the `gain_spread` of the frames is above this. With a fixed exposure it is below."""
    colour_threshold: ClassVar[float] = 0.025
    """The same for the channels without the brightness. Captures with one white balance had .001 to .024."""


class DistilConfig(FrozenModel):
    """Joint distillation of raw frames and repairs. Settings that are missing here are those of [g0]."""

    steps: int | None = Field(
        None,
        ge=1,
        le=1_000_000,
        description="optimisation steps, one view each; unset: a sixteenth of the steps of a first scene. "
        "Settings that this table does not have are those of [g0]",
    )
    begin: float = Field(0.0, ge=0, lt=1, description="start of this training in the schedule, from 0 to 1")
    end: float = Field(1.0, gt=0, le=1, description="end of this training in the schedule, from 0 to 1")
    densify: bool = Field(False, description="change the number and positions of the Gaussians")
    pseudo_share: Annotated[float, Field(ge=0, le=1)] | Literal["even"] = Field(
        0.7,
        description="share of the steps that draw a repaired view; even: the share of repaired views among "
        "all views, so that each view is drawn equally often",
    )
    pseudo_weight: float = Field(0.5, ge=0, description="factor on the loss of a repaired view")

    def applied_to(self, g0: TrainConfig, frames: int) -> TrainConfig:
        """Return the settings of a training that continues from the first scene.

        The regularisation of opacities and scales is off: it serves to remove and relocate Gaussians.
        ``frames`` is the number of active frames.
        """
        share = (1.0 - ROUNDS_END) / G0_END
        inherited = {name: getattr(g0, name) for name in TrainConfig.model_fields}
        own = {
            "steps": self.steps or max(1, round(share * steps_from_frames(frames, g0.quality))),
            "begin": self.begin,
            "end": self.end,
            "densify": g0.densify if self.densify else OFF,
            "opacity_reg": 0.0,
            "scale_reg": 0.0,
        }
        return TrainConfig(**{**inherited, **own})
