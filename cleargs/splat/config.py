"""Settings of everything that trains a scene: the first scene (G0) and the later distillations."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from cleargs.record import Unit
from cleargs.splat.effort import Quality, steps_from_frames


class FormationConfig(BaseModel):
    """What the camera did to each raw frame, found during the training and put into its loss."""

    model_config = ConfigDict(frozen=True, extra="forbid")

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
    accept: float = Field(
        0.02, ge=0, le=1, description="share of a frame's misfit that a model must explain to be taken"
    )
    trust: float = Field(
        1.0,
        ge=0,
        description="how fast an explained frame loses weight with what is left unexplained; 0: never",
    )
    pose: bool = Field(False, description="correct the pose of a frame along with its motion")
    unexplained: float = Field(
        0.0,
        ge=0,
        le=1,
        description="difference of colour (sRGB, mean of a neighbourhood; 0.05, say) beyond which pixels "
        "that stay unexplained count less: for captures with people or things that move; 0: never",
    )


class TrainConfig(BaseModel):
    """How a scene is optimised.

    The trainings of a run follow one schedule (image sizes, growth, SH degree, rates), each in its part from
    ``begin`` to ``end``: G0, RIVR's rounds, the consolidation. All of its numbers are shares of the whole.

    Rates hold for 30,000 steps; a shorter schedule learns faster by ``rate_factor``. They are those of 3DGS
    and gsplat but for scales and opacities, which get twice theirs, the means, which get 2.5 times theirs
    (their noise is gsplat's at 3,200 steps), and the SH terms above the constant, which get four times
    theirs.
    docs/experiments/training.md has what that is worth.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

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
    coarse_factor: float = Field(0.5, gt=0, le=1, description="factor on width and height of reduced images")

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
    growth: float = Field(
        0.05, ge=0, le=1, description="most new Gaussians per refinement, as a share of those there"
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
    min_opacity: float = Field(0.005, gt=0, lt=1, description="opacity at or below which a Gaussian is dead")
    noise: float = Field(
        6.5e4, ge=0, description="noise on the means, as a multiple of their rate (gsplat: 5e5 on 1.6e-4)"
    )
    opacity_reg: float = Field(
        0.005, ge=0, description="factor on the mean opacity in the loss (3DGS-MCMC: 0.01)"
    )
    scale_reg: float = Field(0.01, ge=0, description="factor on the mean scale in the loss")

    lr_means: float = Field(4e-4, ge=0, description="rate of the means at the first step (3DGS: 1.6e-4)")
    lr_means_final: float = Field(
        0.01, gt=0, le=1, description="share of lr_means left at the last step, exponential decay"
    )
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
    lr_exposure: float = Field(1e-3, ge=0, description="rate of the exposure affines, where they are on")
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

    share_of_steps: ClassVar[float] = 1.0
    """Share of a first scene's steps that it takes where ``steps`` is unset."""

    def steps_for(self, frames: int) -> int:
        """Steps of a training of so many active frames."""
        return self.steps or max(1, round(self.share_of_steps * steps_from_frames(frames, self.quality)))

    @property
    def length(self) -> int:
        """The steps; raises ValueError while they are not decided (`cleargs.splat.effort.decided`)."""
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


G0_END, ROUNDS_END = 16 / 19, 18 / 19
"""Where in the schedule of the whole method the first scene is done, and where RIVR's rounds are."""


class G0Config(TrainConfig):
    """The first scene, from the sparse points and the frames that RVA keeps."""

    end: float = Field(
        G0_END,
        gt=0,
        le=1,
        description="share of the schedule that lies behind when this training ends; RIVR and the "
        "consolidation go on from there. 1: for a scene that nothing follows",
    )
    sh_degree: int | None = Field(
        None, ge=0, le=3, description="largest SH degree; unset = from the number of active frames"
    )
    exposure: Literal["auto", "on", "off"] = Field(
        "auto",
        description="one colour affine a frame; auto = on where the frames' gains on the points differ",
    )
    exposure_threshold: float = Field(
        0.05, ge=0, description="auto: spread of the frames' gains from which it is on (0.05 = 5 %)"
    )
    antialias: bool = Field(False, description="compensate the opacity of sub-pixel splats (Mip-Splatting)")
    background: tuple[Unit, Unit, Unit] = Field((0.0, 0.0, 0.0), description="sRGB behind the scene")
    min_points: int = Field(
        10_000,
        ge=1,
        le=5_000_000,
        description="fewest Gaussians to start from, within the budget; points are added to reach it",
    )
    init_scale: float = Field(
        0.5, gt=0, description="starting scale as a share of the distance to the neighbours"
    )
    init_opacity: float = Field(0.5, gt=0, lt=1, description="starting opacity")


class DistilConfig(TrainConfig):
    """Training on from where a scene has got to, with repaired views beside the real ones."""

    share_of_steps: ClassVar[float] = (1.0 - ROUNDS_END) / G0_END

    steps: int | None = Field(
        None,
        ge=1,
        le=1_000_000,
        description="optimisation steps, one view each; unset = a sixteenth of a first scene's",
    )
    densify: bool = Field(False, description="let the strategy change the number and places of the Gaussians")
    opacity_reg: float = Field(0.0, ge=0, description="factor on the mean opacity in the loss")
    scale_reg: float = Field(0.0, ge=0, description="factor on the mean scale in the loss")
    pseudo_share: Annotated[float, Field(ge=0, le=1)] | Literal["even"] = Field(
        0.7,
        description="share of the steps that draw a repaired view; even: the repaired views' share of all "
        "views, so that each is drawn as often as any raw one",
    )
    pseudo_weight: float = Field(1.0, ge=0, description="factor on the loss of a repaired view")
