"""How a scene is trained."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from pydantic import Field, model_validator

from cleargs.base_model import Inherited, Settings

# Steps and Gaussians where the settings leave them open. Neither is one number for all captures. Steps follow
# the frames, since each is to be seen often enough; Gaussians follow the pixels, since they have that much to
# say. `quality` scales both. docs/speed.md has what each step up costs and brings.
Quality = Literal["draft", "standard", "high"]

STEPS_PER_FRAME = 50
MIN_STEPS, MAX_STEPS = 3200, 7200
STEPS_FACTOR: dict[Quality, float] = {"draft": 0.25, "standard": 1.0, "high": 4.0}

PIXELS_PER_GAUSSIAN = 160
MIN_BUDGET = 40_000
BUDGET_FACTOR: dict[Quality, float] = {"draft": 0.5, "standard": 1.0, "high": 2.0}

INIT_SCALE = 0.5
"""Starting scale of a Gaussian per distance to its neighbours (docs/experiments/training.md)."""
INIT_OPACITY = 0.5
"""Starting opacity of a Gaussian (3DGS-MCMC)."""


def steps_from_frames(frames: int, quality: Quality = "standard") -> int:
    """Steps of the first scene of a capture with so many active frames."""
    return round(STEPS_FACTOR[quality] * min(max(STEPS_PER_FRAME * frames, MIN_STEPS), MAX_STEPS))


def budget_from_pixels(pixels: int, max_budget: int, quality: Quality = "standard") -> int:
    """Most Gaussians of a capture whose active frames hold ``pixels`` pixels in all.

    One Gaussian (59 numbers at SH degree 3) for 160 pixels (480 numbers, most seen by several frames),
    40,000 at least, since fewer cost a small capture a dB, and ``max_budget`` at most: all times the
    quality's factor.
    """
    standard = min(max(pixels // PIXELS_PER_GAUSSIAN, MIN_BUDGET), max_budget)
    return max(1, int(BUDGET_FACTOR[quality] * standard))


class FormationConfig(Settings):
    """What the camera did to each raw frame, found during the training and put into its loss."""

    enabled: bool = Field(
        True,
        description="compare raw frames with the render as their camera saw it: blurred by its motion, "
        "skewed by its rolling shutter, out of focus",
    )
    start: float = Field(
        0.25, ge=0, le=1, description="share of the schedule before formations are first estimated"
    )
    every: int = Field(
        10, ge=1, description="a frame's formation is estimated again after so many steps on it"
    )
    pose: bool = Field(False, description="correct the pose of a frame along with its motion")
    unexplained: float = Field(
        0.0,
        ge=0,
        le=1,
        description="difference of colour (sRGB, mean of a neighbourhood; 0.05, say) beyond which pixels "
        "that stay unexplained count less: for captures with people or things that move; 0: never",
    )

    accept: ClassVar[float] = 0.02
    """Share of a frame's misfit that a model must explain to be taken (docs/experiments/formation.md)."""
    trust: ClassVar[float] = 1.0
    """Power of the share that an explained frame keeps of its weight: in proportion to its misfit."""


class TrainConfig(Settings):
    """How a scene is optimised.

    The trainings of a run follow one schedule (image sizes, growth, SH degree, rates), each in its part from
    ``begin`` to ``end``: G0, RIVR's rounds, the consolidation. All of its numbers are shares of the whole.

    Rates hold for 30,000 steps; a shorter schedule learns faster by ``rate_factor``. They are those of 3DGS
    and gsplat but for scales and opacities, which get twice theirs, the means, which get 2.5 times theirs
    (their noise is gsplat's at 3,200 steps), and the SH terms above the constant, which get four times
    theirs.
    docs/experiments/training.md has what that is worth.
    """

    RETIRED: ClassVar[Mapping[str, Any]] = {"strategy": "mcmc", "adaptive": Inherited("g0", strictly=False)}

    quality: Quality = Field(
        "standard",
        description="what is spent where steps and budget are unset: draft a quarter of the steps and half "
        "of the Gaussians of standard, high four times and twice",
    )
    steps: int | None = Field(
        None,
        ge=1,
        le=1_000_000,
        description="optimisation steps, one view each; unset = 50 an active frame, 3,200 to 7,200, times "
        "what quality says",
    )
    begin: float = Field(
        0.0, ge=0, lt=1, description="share of the schedule that lies behind when this training begins"
    )
    end: float = Field(
        1.0,
        gt=0,
        le=1,
        description="share of the schedule that lies behind when this training ends",
    )
    ssim_lambda: float = Field(0.2, ge=0, le=1, description="share of D-SSIM in the loss, the rest is L1")
    coarse_share: float = Field(
        0.25,
        ge=0,
        le=1,
        description="share of the schedule, its first, with reduced images; 0 = off",
    )

    densify: bool = Field(True, description="let the strategy change the number and places of the Gaussians")
    budget: int | None = Field(
        None,
        ge=1,
        le=20_000_000,
        description="most Gaussians, from the first step on; unset = growth ends at a number from the pixels",
    )
    max_budget: int = Field(
        400_000,
        ge=1,
        le=20_000_000,
        description="most Gaussians where budget is unset, before the quality's factor",
    )
    refine_every: float = Field(
        1 / 64, gt=0, le=1, description="share of the schedule between refinements; one step at least"
    )
    refine_start: float = Field(
        0.05, ge=0, le=1, description="share of the schedule before the first refinement"
    )
    refine_stop: float = Field(
        0.8, ge=0, le=1, description="share of the schedule after which nothing is refined"
    )
    noise: float = Field(
        6.5e4, ge=0, description="noise on the means, as a multiple of their rate (gsplat: 5e5 on 1.6e-4)"
    )
    opacity_reg: float = Field(
        0.005, ge=0, description="factor on the mean opacity in the loss (3DGS-MCMC: 0.01)"
    )
    scale_reg: float = Field(0.01, ge=0, description="factor on the mean scale in the loss")

    lr_means: float = Field(4e-4, ge=0, description="rate of the means at the first step (3DGS: 1.6e-4)")
    rate_factor: float | None = Field(
        None,
        gt=0,
        le=20,
        description="factor on the rates of means, scales, rotations and SH; unset = sqrt(30,000 / steps of "
        "the whole schedule), 1 to 6",
    )
    lr_final: float = Field(
        0.1, gt=0, le=1, description="share of all other rates left at the last step, exponential decay"
    )
    lr_scales: float = Field(1e-2, ge=0, description="rate of the log scales (3DGS: 5e-3)")
    lr_rotations: float = Field(1e-3, ge=0, description="rate of the quaternions")
    lr_opacities: float = Field(0.1, ge=0, description="rate of the opacity logits (3DGS: 0.05)")
    lr_sh: float = Field(2.5e-3, ge=0, description="rate of the SH constant term; the others get a fifth")
    sh_every: float = Field(
        5 / 32,
        ge=0,
        le=1,
        description="share of the schedule between raises of the SH degree from 0 up; 0 = all degrees from "
        "the first step",
    )

    formation: FormationConfig = Field(FormationConfig(), description="what the camera did to each raw frame")

    checkpoint_interval: int = Field(
        200,
        ge=1,
        description="steps between checkpoints; changes no result",
        json_schema_extra={"key": False},
    )
    cache_mb: int = Field(
        1024,
        ge=0,
        description="memory for decoded images, MiB; changes no result",
        json_schema_extra={"key": False},
    )

    coarse_factor: ClassVar[float] = 0.5
    """Factor on width and height of reduced images."""
    growth: ClassVar[float] = 0.05
    """Most new Gaussians per refinement, as a share of those there (3DGS-MCMC)."""
    min_opacity: ClassVar[float] = 0.005
    """Opacity at or below which a Gaussian is dead (3DGS)."""
    lr_means_final: ClassVar[float] = 0.01
    """Share of ``lr_means`` left at the last step, exponential decay (3DGS)."""
    lr_exposure: ClassVar[float] = 1e-3
    """Rate of the exposure affines, where they are on (the last one of 3DGS)."""

    def steps_for(self, frames: int) -> int:
        """Steps of a training of so many active frames."""
        return self.steps or steps_from_frames(frames, self.quality)

    def budget_for(self, pixels: int) -> int:
        """Most Gaussians of a training whose active frames hold so many pixels in all."""
        return self.budget or budget_from_pixels(pixels, self.max_budget, self.quality)

    @property
    def length(self) -> int:
        """The steps; raises ValueError while they are not decided (`cleargs.splat.budget.resolve_config`)."""
        if self.steps is None:
            raise ValueError("the steps of this training are not decided yet")
        return self.steps

    @property
    def planned(self) -> int:
        """Steps of the whole schedule, of which this training has its part."""
        return round(self.length / (self.end - self.begin))

    @property
    def first(self) -> int:
        """The step of the schedule that it begins with."""
        return round(self.begin * self.planned)

    @property
    def refine_interval(self) -> int:
        """Steps between refinements."""
        return max(1, round(self.refine_every * self.planned))

    @model_validator(mode="after")
    def _ends_after_its_begin(self) -> TrainConfig:
        if self.begin >= self.end:
            raise ValueError(f"the schedule cannot end at {self.end} where it begins at {self.begin}")
        return self
