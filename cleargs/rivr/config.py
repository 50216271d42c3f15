"""Settings of RIVR and of the consolidation."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from cleargs.record import Record
from cleargs.splat.config import G0_END, ROUNDS_END, DistilConfig

MAX_ROUNDS = 16
"""Most rounds of RIVR."""


class HarmConfig(Record):
    """When a distilled scene counts as worse than G0 on the frames held back from repair.

    These frames stay among the raw supervision, as they were for G0. Kept from it too, G0 would be measured
    on frames it was trained on and the distilled scene on unseen ones: PSNR then falls by 2 to 3 dB while the
    scene gains 0.9 dB against the truth (16 frames, 480x270), and no margin tells harm from that.
    """

    held_back: float = Field(
        0.125,
        ge=0.0,
        le=1.0,
        description="share of the reliable frames (at least one) that get no repair and judge the result; "
        "0: every frame may be repaired and nothing is rejected, the paper's way. "
        "To be set alike in [rivr.harm] and [consolidate.harm]",
    )
    psnr_margin: float = Field(0.5, ge=0.0, le=100.0, description="mean PSNR may fall by this much, dB")
    score_margin: float = Field(1.0, ge=0.0, le=100.0, description="mean primary score may fall by this much")


class GateConfig(Record):
    """When a repair is refused because it disagrees with both the raw frame and the render.

    docs/experiments/rivr.md has the measurements behind the thresholds.
    """

    max_share: float = Field(
        0.1, ge=0.0, le=1.0, description="share of the blocks that may disagree; 1: no repair is refused"
    )
    max_shift: float = Field(0.6, ge=0.0, description="a block disagrees when it is further out of place, px")
    max_colour: float = Field(
        0.06, ge=0.0, description="or when its mean light differs by more in any channel, in sRGB"
    )


class RepairDistilConfig(DistilConfig):
    """Joint distillation of raw frames and repairs."""

    pseudo_weight: float = Field(0.5, ge=0, description="factor on the loss of a repaired view")


class RoundsDistilConfig(RepairDistilConfig):
    """The distillations of RIVR's rounds, which follow each other in one part of the schedule."""

    begin: float = Field(
        G0_END, ge=0, lt=1, description="share of the schedule that lies behind when the first round begins"
    )
    end: float = Field(
        ROUNDS_END, gt=0, le=1, description="share of the schedule that lies behind when the last round ends"
    )


class ConsolidationDistilConfig(RepairDistilConfig):
    """The final distillation."""

    begin: float = Field(
        ROUNDS_END, ge=0, lt=1, description="share of the schedule that lies behind when this training begins"
    )


class RivrConfig(Record):
    """Render-Guided In-Video Restoration."""

    rounds: int = Field(2, ge=1, le=MAX_ROUNDS, description="times that every target frame is repaired")
    targets: Literal["auto", "all", "degraded"] = Field(
        "auto",
        description="frames to repair: all registered training frames, or those that are not strong; auto = "
        "all, but degraded in a draft",
    )
    expert: str = Field(
        "embedded",
        description="restoration expert: embedded, a name of `cleargs models list`, an ONNX file, or one "
        "that another package brings",
        json_schema_extra={"key": False, "plugin": "experts"},  # its content is in the key
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
        description="most target frames that are repaired from one scene: a round goes along the trajectory "
        "in groups, and what is accepted in one is distilled before the next is rendered (the paper's way); "
        "unset = the whole round at once. The groups share the round's distil.steps",
    )
    margin: float = Field(
        1.0, ge=0.0, le=100.0, description="primary scores this close to the best go to the tie-break scorer"
    )
    keep_raw: bool = Field(
        True,
        description="a raw frame that needs no repair gets none and keeps supervising by itself; false: "
        "the paper's, where every target gets a pseudo observation",
    )
    fuse_sigma: float = Field(
        2.0, gt=0.0, le=100.0, description="Gaussian that splits detail from base in the fusion, px"
    )
    use_observation: bool = Field(
        True, description="false: the ablation whose expert restores the render instead of the raw frame"
    )
    undo_motion: bool = Field(
        True,
        description="with use_observation: the raw frame loses the blur and the skew of the camera's motion, "
        "found by comparing it with the render, before the expert restores it; false: the paper's",
    )
    use_fused: bool = Field(
        False,
        description="a third candidate, the render with the detail of what was restored; true: the paper's. "
        "With undo_motion the restored frame has the render's detail already, and would have it twice",
    )
    gate: GateConfig = Field(GateConfig(), description="when a repair is refused")
    distil: RoundsDistilConfig = Field(RoundsDistilConfig(), description="distillation of each round")
    harm: HarmConfig = Field(HarmConfig(), description="when the distilled scene is rejected for G0")

    @property
    def which_targets(self) -> Literal["all", "degraded"]:
        """``targets``, decided: a draft is a look within minutes, and repairs take most of RIVR's time."""
        if self.targets == "auto":
            return "degraded" if self.distil.quality == "draft" else "all"
        return self.targets

    def distillation(self, round: int, done: int, steps: int, frames: int) -> RoundsDistilConfig:
        """A training of ``steps`` steps in round ``round`` (from 1), ``done`` of whose steps lie behind, with
        its part of the schedule.

        frames: active ones, on which the steps of a round rest where they are unset.
        """
        each = self.distil.steps_for(frames)
        step = (self.distil.end - self.distil.begin) / (self.rounds * each)
        begin = self.distil.begin + step * ((round - 1) * each + done)
        return self.distil.model_copy(update={"steps": steps, "begin": begin, "end": begin + step * steps})


class ConsolidateConfig(Record):
    """Full-Trajectory Repair Consolidation."""

    scorer: str = Field(
        "clarity-net",
        description="measures harm: the name of a scorer, or the path of an ONNX file",
        json_schema_extra={"key": False, "plugin": "scorers"},  # its content is in the key
    )
    distil: ConsolidationDistilConfig = Field(
        ConsolidationDistilConfig(), description="the final distillation"
    )
    harm: HarmConfig = Field(HarmConfig(), description="when the consolidated scene is rejected")
