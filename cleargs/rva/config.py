"""Settings of the RVA stage: every number of the paper's table tab:rva_params, and what the paper leaves
open.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

Unit = Annotated[float, Field(ge=0.0, le=1.0)]
"""A number in [0, 1]."""

_SUM_TOLERANCE = 1e-9  # decimal weights such as 0.30 + 0.25 + ... do not add up to 1 exactly in binary


class RvaConfig(BaseModel):
    """Reliability-aware View Allocation. The defaults are the paper's."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    enabled: bool = Field(
        True,
        description="false: the all-view ablation. Every registered frame gets weight 1 and the role strong; "
        "cues, scores and geometry are still computed and reported",
    )
    weighting: Literal["graded", "binary"] = Field(
        "graded",
        description="graded: the paper's roles and weights; binary: the baseline that drops blurry frames. "
        "Weight 1 for the better frames by R - B, 0 for the others, without coverage compensation",
    )
    binary_share: float = Field(
        0.5,
        gt=0.0,
        le=1.0,
        description="binary: this share of the registered frames (at least one) is kept, and every reliable "
        "frame beyond it",
    )
    coverage: bool = Field(
        True, description="reactivate one suppressed frame in every uncovered trajectory bin"
    )
    evaluator: Literal["statistics"] = Field(
        "statistics", description="who judges appearance; statistics: image and video statistics, no network"
    )
    frames_per_bin: int = Field(
        8, ge=1, le=10_000, description="registered frames a trajectory bin holds on average"
    )
    stand_in_share: float = Field(
        0.10,
        gt=0.0,
        le=1.0,
        description="when no frame is reliable, this share of the registered frames (at least one), "
        "best by R - B, stands in for the reliable set in the geometry",
    )

    w_R: tuple[Unit, Unit, Unit, Unit, Unit] = Field(
        (0.30, 0.25, 0.20, 0.15, 0.10),
        description="weights in R of sharpness, structure, texture, cleanness, exposure; they sum to 1",
    )
    w_B: tuple[Unit, Unit, Unit, Unit, Unit, Unit] = Field(
        (0.25, 0.15, 0.20, 0.15, 0.15, 0.10),
        description="weights in B of motion blur, defocus, ghosting, exposure failure, unreliable texture, "
        "artifacts; they sum to 1",
    )
    tau_R: float = Field(
        0.70, ge=0.0, le=1.0, description="a reliable (and strong) frame has at least this R"
    )
    tau_B: float = Field(0.60, ge=0.0, le=1.0, description="a reliable (and strong) frame has at most this B")

    gamma_c: float = Field(
        0.65, ge=0.0, le=1.0, description="share of the camera-centre distance in a pose distance"
    )
    gamma_v: float = Field(0.35, ge=0.0, le=1.0, description="share of the view angle in a pose distance")
    alpha: float = Field(
        0.45, ge=0.0, le=1.0, description="weight of the coverage gain C in the geometric utility G"
    )
    beta: float = Field(0.35, ge=0.0, le=1.0, description="weight of the pose diversity D in G")
    eta: float = Field(
        0.30, ge=0.0, le=1.0, description="weight of the visibility redundancy O, subtracted from G"
    )

    lambda_G: float = Field(
        0.35, ge=0.0, le=1.0, description="weight of G when a frame to reactivate is chosen"
    )
    lambda_R: float = Field(
        0.25, ge=0.0, le=1.0, description="weight of R when a frame to reactivate is chosen"
    )
    lambda_B: float = Field(
        0.30, ge=0.0, le=1.0, description="weight of 1 - B when a frame to reactivate is chosen"
    )
    lambda_Z: float = Field(
        0.10, ge=0.0, le=1.0, description="weight of the centrality Z when a frame to reactivate is chosen"
    )
    reactivated_weight: float = Field(
        0.12, gt=0.0, le=1.0, description="weight of a coverage-reactivated frame"
    )

    strong_base: float = Field(0.80, gt=0.0, le=1.0, description="weight of a strong frame: base + gain R")
    strong_gain: float = Field(0.20, ge=0.0, le=1.0, description="weight of a strong frame: base + gain R")
    geometric_G: float = Field(0.60, ge=0.0, le=1.0, description="a geometric frame has at least this G")
    geometric_B: float = Field(0.80, ge=0.0, le=1.0, description="a geometric frame has at most this B")
    geometric_mix: tuple[Unit, Unit] = Field(
        (0.35, 0.65), description="weight of a geometric frame: base + gain (mix[0] R + mix[1] G); sums to 1"
    )
    auxiliary_R: float = Field(0.35, ge=0.0, le=1.0, description="an auxiliary frame has at least this R")
    auxiliary_G: float = Field(0.25, ge=0.0, le=1.0, description="an auxiliary frame has at least this G")
    auxiliary_B: float = Field(0.75, ge=0.0, le=1.0, description="an auxiliary frame has at most this B")
    auxiliary_mix: tuple[Unit, Unit] = Field(
        (0.50, 0.50), description="weight of an auxiliary frame: base + gain (mix[0] R + mix[1] G); sums to 1"
    )
    attenuated_base: float = Field(
        0.30, gt=0.0, le=1.0, description="base of the weight of geometric and auxiliary frames"
    )
    attenuated_gain: float = Field(
        0.30, ge=0.0, le=1.0, description="gain of the weight of geometric and auxiliary frames"
    )

    @model_validator(mode="after")
    def _ranges_hold(self) -> RvaConfig:
        """R, B, pose distances and frame weights stay in [0, 1] only if these sums do."""
        for name in ("w_R", "w_B", "geometric_mix", "auxiliary_mix"):
            total = sum(getattr(self, name))
            if abs(total - 1.0) > _SUM_TOLERANCE:
                raise ValueError(f"{name} must sum to 1, not {total:g}")
        if abs(self.gamma_c + self.gamma_v - 1.0) > _SUM_TOLERANCE:
            raise ValueError(f"gamma_c + gamma_v must be 1, not {self.gamma_c + self.gamma_v:g}")
        for base, gain in (("strong_base", "strong_gain"), ("attenuated_base", "attenuated_gain")):
            if getattr(self, base) + getattr(self, gain) > 1.0 + _SUM_TOLERANCE:
                raise ValueError(f"{base} + {gain} must not exceed 1: it is the largest weight of a frame")
        return self
