"""Settings of a training, and the default numbers of steps and Gaussians."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field, field_validator, model_validator

from cleargs.base_model import FrozenModel, Unit
from cleargs.plugins import require_known

# Steps and Gaussians if the settings leave them unset (docs/experiments/training.md): steps follow the number
# of frames, Gaussians the number of pixels. `quality` scales both; docs/speed.md lists its cost and gain.
Quality = Literal["draft", "standard", "high"]

STEPS_PER_FRAME = 40
MIN_STEPS, MAX_STEPS = 2400, 3600
STEPS_FACTOR: dict[Quality, float] = {"draft": 1 / 3, "standard": 1.0, "high": 6.0}

PIXELS_PER_GAUSSIAN = 30
MIN_BUDGET = 40_000
BUDGET_FACTOR: dict[Quality, float] = {"draft": 0.5, "standard": 1.0, "high": 2.0}

MCMC_NAME, OFF = "mcmc", "off"
"""Values of ``densify`` that need no other package."""

COARSE_SHARE, DRAFT_COARSE_SHARE, DRAFT_COARSE_PIXELS = 0.25, 0.5, 200_000
"""Share of the schedule with reduced images; the same in a draft with images of at least this many pixels.
Smaller ones would lose detail, and a longer training gains nothing (docs/experiments/training.md)."""

INIT_SCALE = 0.5
"""Initial scale of a Gaussian, relative to the distance of its neighbours (docs/experiments/training.md)."""
INIT_OPACITY = 0.5
"""Initial opacity of a Gaussian (3DGS-MCMC)."""


def steps_from_frames(frames: int, quality: Quality = "standard") -> int:
    """Return the number of steps of G0 for this number of active frames."""
    return round(STEPS_FACTOR[quality] * min(max(STEPS_PER_FRAME * frames, MIN_STEPS), MAX_STEPS))


def budget_from_pixels(pixels: int, max_budget: int, quality: Quality = "standard") -> int:
    """Return the maximum number of Gaussians for a capture.

    It is one Gaussian (59 numbers at SH degree 3) per 30 pixels (90 numbers, most seen by several frames),
    times the factor of the quality. Fewer than 40,000 reduce the PSNR of small captures by 1 dB.
    ``max_budget`` is the upper limit at standard quality.
    """
    standard = min(max(pixels // PIXELS_PER_GAUSSIAN, MIN_BUDGET), max_budget)
    return max(1, int(BUDGET_FACTOR[quality] * standard))


class FormationConfig(FrozenModel):
    """Settings of image formation, which is estimated per frame during the training."""

    enabled: bool = Field(
        True,
        description="compare each frame image with the render after image formation: motion blur, rolling "
        "shutter, defocus",
    )
    start: float = Field(
        0.25, ge=0, le=1, description="fraction of the schedule before image formation is first estimated"
    )
    every: int = Field(
        10,
        ge=1,
        description="training steps on a frame between two estimates of its image formation; twice as many "
        "if it follows the motion that ingest measured",
    )
    first_search: bool = Field(
        True,
        description="search every frame for blur once; false: only frames in which a short test finds blur",
    )
    pose: Literal["auto", "on", "off"] = Field(
        "auto",
        description="correct the pose of a frame together with its motion; auto = where ingest found or "
        "adjusted the poses, that is, unless those of the input fit within ingest.refine_above",
    )
    movement: Literal["auto", "on", "off"] = Field(
        "auto",
        description="do not train on regions that move: they differ from the scene of the other frames; "
        "auto = where RVA finds something in front of the scene in a frame (ghosting of 0.3 or more); with "
        "the model people, where a person, an animal, a vehicle or a screen is seen",
    )

    @field_validator("pose", mode="before")
    @classmethod
    def _pose_was_true_or_false(cls, value: object) -> object:
        return ("on" if value else "off") if isinstance(value, bool) else value

    accept: ClassVar[float] = 0.02
    """Share of the residual (mean difference) that a model must explain (docs/experiments/formation.md)."""
    trust: ClassVar[float] = 1.0
    """Exponent p in the weight of an explained frame, max(w_RVA, min(1, median residual / residual)^p)."""


class TrainConfig(FrozenModel):
    """Settings of the optimisation of a scene.

    All trainings of a run (G0, the rounds of RIVR, the consolidation) share one schedule of image sizes,
    growth, SH degree and rates. Each training covers the part from ``begin`` to ``end``. Times in the
    schedule are fractions of the whole.

    Rates are for 30,000 steps. A shorter schedule multiplies them by ``rate_factor``. They are those of 3DGS
    and gsplat, except: scales and opacities have twice the rate, means 2.5 times, and SH terms above the
    constant four times. The noise on the means equals gsplat's at 3,200 steps. Source of these factors:
    docs/experiments/training.md.
    """

    quality: Quality = Field(
        "standard",
        description="size of all trainings if steps and budget are unset: draft has a third of the steps "
        "of standard and half of its maximum number of Gaussians; high has 6 times the steps and twice the "
        "Gaussians. A draft also follows the recipe draft: at most 60 frames of 640 px, and no repairs",
        json_schema_extra={"recipes": ["draft"]},
    )
    steps: int | None = Field(
        None,
        ge=1,
        le=1_000_000,
        description="optimisation steps, one view each; unset = 40 per active frame, 2,400 to 3,600, times "
        "the factor of the quality",
    )
    begin: float = Field(0.0, ge=0, lt=1, description="start of this training in the schedule, as a fraction")
    end: float = Field(1.0, gt=0, le=1, description="end of this training in the schedule, as a fraction")
    background: tuple[Unit, Unit, Unit] | None = Field(
        None,
        description="sRGB behind the scene; unset = black, and in training a random grey at each step, so "
        "that what was filmed becomes opaque",
    )
    ssim_lambda: float = Field(0.2, ge=0, le=1, description="weight of D-SSIM in the loss; L1 has the rest")
    texture: float = Field(
        0.1,
        ge=0,
        description="weight of the term of the loss that compares texture, in the last 30 % of the schedule; "
        "0 = off",
    )
    coarse_share: float | None = Field(
        None,
        ge=0,
        le=1,
        description="fraction of the schedule, at its start, with reduced images; 0 = off; unset = 0.25, in "
        "a draft of images of 200,000 pixels or more 0.5",
    )

    densify: str = Field(
        MCMC_NAME,
        description="strategy that splits, moves and adds Gaussians during the training: mcmc, off, or one "
        "of another package",
        json_schema_extra={"plugin": "densifiers"},
    )
    budget: int | None = Field(
        None,
        ge=1,
        le=20_000_000,
        description="maximum number of Gaussians, also at the start; unset = growth stops at a number that "
        "follows from the pixels",
    )
    max_budget: int = Field(
        400_000,
        ge=1,
        le=20_000_000,
        description="maximum number of Gaussians if budget is unset, before the factor of the quality",
    )
    refine_every: float = Field(
        1 / 64, gt=0, le=1, description="fraction of the schedule between refinements (at least one step)"
    )
    refine_start: float = Field(
        0.05, ge=0, le=1, description="fraction of the schedule before the first refinement"
    )
    refine_stop: float = Field(
        0.8, ge=0, le=1, description="fraction of the schedule after which refinements stop"
    )
    noise: float = Field(
        6.5e4, ge=0, description="noise on the means, as a multiple of their rate (gsplat: 5e5 with 1.6e-4)"
    )
    opacity_reg: float = Field(
        0.005, ge=0, description="weight of the mean opacity in the loss (3DGS-MCMC: 0.01)"
    )
    scale_reg: float = Field(0.01, ge=0, description="weight of the mean scale in the loss")

    lr_means: float = Field(4e-4, ge=0, description="rate of the means at the first step (3DGS: 1.6e-4)")
    rate_factor: float | None = Field(
        None,
        gt=0,
        le=20,
        description="factor on the rates of means, scales, rotations and SH; unset = sqrt(30,000 / steps of "
        "the whole schedule), 1 to 6",
    )
    lr_final: float = Field(
        0.1, gt=0, le=1, description="factor on all other rates at the last step, by exponential decay"
    )
    lr_scales: float = Field(1e-2, ge=0, description="rate of the log scales (3DGS: 5e-3)")
    lr_rotations: float = Field(1e-3, ge=0, description="rate of the quaternions")
    lr_opacities: float = Field(0.1, ge=0, description="rate of the opacity logits (3DGS: 0.05)")
    lr_sh: float = Field(2.5e-3, ge=0, description="rate of the SH constant term; the others get a fifth")
    sh_every: float = Field(
        5 / 32,
        ge=0,
        le=1,
        description="fraction of the schedule after which the SH degree, from 0, rises by one; 0 = all "
        "degrees from the first step",
    )

    formation: FormationConfig = Field(FormationConfig(), description="image formation of each frame")

    checkpoint_interval: int = Field(
        200,
        ge=1,
        description="least steps between checkpoints; does not change results",
        json_schema_extra={"key": False},
    )
    cache_mb: int = Field(
        1024,
        ge=0,
        description="memory for decoded images, MiB; does not change results",
        json_schema_extra={"key": False},
    )

    coarse_factor: ClassVar[float] = 0.5
    """Factor on width and height of reduced images."""
    min_opacity: ClassVar[float] = 0.005
    """Opacity up to which a Gaussian is dead (3DGS)."""
    lr_means_final: ClassVar[float] = 0.01
    """Factor on ``lr_means`` at the last step, by exponential decay (3DGS)."""
    lr_exposure: ClassVar[float] = 1e-3
    """Rate of exposure compensation, if it is on (the final rate of 3DGS)."""

    def steps_for(self, frames: int) -> int:
        """Return the number of steps of a training on this number of active frames."""
        return self.steps or steps_from_frames(frames, self.quality)

    def budget_for(self, pixels: int) -> int:
        """Return the maximum number of Gaussians for active frames with ``pixels`` pixels in total."""
        return self.budget or budget_from_pixels(pixels, self.max_budget, self.quality)

    def coarse_share_for(self, pixels: int) -> float:
        """Return the share of the schedule with reduced images, for images of this mean number of pixels."""
        if self.coarse_share is not None:
            return self.coarse_share
        large_draft = self.quality == "draft" and pixels >= DRAFT_COARSE_PIXELS
        return DRAFT_COARSE_SHARE if large_draft else COARSE_SHARE

    @property
    def coarse_steps(self) -> float:
        """Number of steps of the whole schedule with reduced images.

        Raises:
            ValueError: The share is unset; `cleargs.splat.budget.resolve_config` sets it.
        """
        if self.coarse_share is None:
            raise ValueError("the share of reduced images is not set yet")
        return self.coarse_share * self.planned

    @property
    def growth(self) -> float:
        """Maximum growth per refinement (3DGS-MCMC: 0.05). 0.065 ends at twice the number of Gaussians."""
        return 0.065 if self.quality == "high" else 0.05

    @property
    def length(self) -> int:
        """Number of steps of this training.

        Raises:
            ValueError: The number is unset; `cleargs.splat.budget.resolve_config` sets it.
        """
        if self.steps is None:
            raise ValueError("the number of steps is not set yet")
        return self.steps

    @property
    def planned(self) -> int:
        """Number of steps of the whole schedule."""
        return round(self.length / (self.end - self.begin))

    @property
    def first(self) -> int:
        """First step of this training in the schedule."""
        return round(self.begin * self.planned)

    @property
    def refine_interval(self) -> int:
        """Steps between refinements."""
        return max(1, round(self.refine_every * self.planned))

    @field_validator("densify", mode="before")
    @classmethod
    def _densify_is_known(cls, name: object) -> object:
        if isinstance(name, bool):  # in older recipes
            return MCMC_NAME if name else OFF
        return require_known("densifiers", name, (MCMC_NAME, OFF)) if isinstance(name, str) else name

    @model_validator(mode="after")
    def _ends_after_its_begin(self) -> TrainConfig:
        if self.begin >= self.end:
            raise ValueError(f"end is {self.end}, but it must be greater than begin, {self.begin}")
        return self
