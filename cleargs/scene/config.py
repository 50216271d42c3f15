"""Settings of the first scene, and the libraries of its kernels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from pydantic import Field

from cleargs.plugins import installed_version
from cleargs.splat.config import TrainConfig
from cleargs.types import Device

G0_END = 16 / 19
"""Position, from 0 to 1, in the schedule of all trainings: the end of G0."""


def kernel_libraries(device: Device, config: object) -> Mapping[str, str]:
    """Return the versions of the other libraries of the kernels on ``device``."""
    return {"triton": installed_version("triton")} if device == "cuda" else {}


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
