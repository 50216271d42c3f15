"""Settings of the stages that train: of G0, and those that rivr and consolidate share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import Field

from cleargs.base_model import FrozenModel
from cleargs.rivr.config import RepairConfig
from cleargs.rivr.harm import HarmConfig
from cleargs.scene.config import G0_END, kernel_libraries
from cleargs.splat.config import OFF, TrainConfig, steps_from_frames
from cleargs.types import Device

ROUNDS_END = 18 / 19
"""Position, from 0 to 1, in the schedule of all trainings: the end of RIVR's rounds."""

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

    return {"onnxruntime": runtime_version(device), **kernel_libraries(device, config)}


class DistilConfig(FrozenModel):
    """Joint distillation of frame images and repairs. Settings that are missing here are those of [g0]."""

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


class RoundsConfig(DistilConfig):
    """The distillations of RIVR's rounds, which follow each other in one part of the schedule."""

    begin: float = Field(
        G0_END, ge=0, lt=1, description="start of the first round in the schedule, as a fraction"
    )
    end: float = Field(
        ROUNDS_END, gt=0, le=1, description="end of the last round in the schedule, as a fraction"
    )


class RivrConfig(RepairConfig):
    """Render-Guided In-Video Restoration."""

    rounds: int = Field(
        2,
        ge=0,
        le=MAX_ROUNDS,
        description="rounds in which every target frame is repaired; 0: no repairs, the scene is that of g0",
    )
    targets: Literal["auto", "all"] = Field(
        "auto",
        description="frames to repair: all registered training frames; auto = those that image formation and "
        "RVA leave in need, and the next ones up to a sixteenth of the frames",
    )
    expert: str = Field(
        "embedded",
        description="restoration expert: embedded, a name of `cleargs models list`, an ONNX file, or one "
        "of another package",
        json_schema_extra={"key": False, "plugin": "experts"},  # the key contains the digest of its file
    )
    primary_scorer: str = Field(
        "clarity-net",
        description="decides between candidates: the name of a scorer, or an ONNX file",
        json_schema_extra={"key": False, "plugin": "scorers"},  # as for the expert
    )
    tiebreak_scorer: str = Field(
        "naturalness-stats",
        description="decides near-ties: the name of a scorer, or an ONNX file",
        json_schema_extra={"key": False, "plugin": "scorers"},
    )
    group: int | None = Field(
        None,
        ge=1,
        description="maximum number of target frames that are repaired from one scene: a round has groups "
        "along the trajectory, and the repairs of a group are distilled before the next one is rendered, as "
        "in the paper; unset = one group. The groups share distil.steps of the round",
    )
    distil: RoundsConfig = Field(RoundsConfig(), description="distillation of each round")
    harm: HarmConfig = Field(
        HarmConfig(), description="limits beyond which the distilled scene is rejected for G0"
    )

    def distillation(self, g0: TrainConfig, round: int, done: int, steps: int, frames: int) -> TrainConfig:
        """Return the settings of a training of ``steps`` steps with its part of the schedule.

        ``round`` counts from 1. ``done`` steps of the round precede this training. If the steps of a round
        are unset, they follow from the number of active ``frames``.
        """
        whole = self.distil.applied_to(g0, frames)
        step = (whole.end - whole.begin) / (self.rounds * whole.length)
        begin = whole.begin + step * ((round - 1) * whole.length + done)
        return whole.model_copy(update={"steps": steps, "begin": begin, "end": begin + step * steps})
