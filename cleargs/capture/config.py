"""Settings of the ingest stage."""

from __future__ import annotations

import re
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from cleargs.plugins import require_known

SfmModel = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"]


class IngestConfig(BaseModel):
    """How a capture becomes undistorted frames with poses and sparse points."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    fps: float | None = Field(
        None,
        gt=0,
        le=1000,
        description="frames per second to take from a video, each the sharpest nearby; unset: max_frames "
        "alone decides",
    )
    max_frames: int = Field(
        150,
        ge=3,
        description="most frames to take, evenly; of a video, the sharpest nearby",
    )
    max_size: int = Field(
        960,
        ge=64,
        description="long side of the published images, px; never enlarged. Images, masks and videos of more "
        "than 2^28 pixels are refused",
    )
    holdout: str = Field(
        "none",
        description="test frames: none | every:N (frames 0, N, 2N, ...) | sharpest:N (the sharpest of every "
        "N registered frames in a row) | names, stems or patterns such as eval_*, separated by commas",
    )
    layout: str = Field(
        "auto",
        json_schema_extra={"key": False, "plugin": "layouts"},  # what is read in consequence is in the key
        description="how the input is read; auto: by what lies in it; or one that another package brings",
    )
    poses: Literal["auto", "sfm"] = Field(
        "auto", description="auto: the input's poses where it has them; sfm: ignore its poses and cameras"
    )
    refine_above: float = Field(
        0.6,
        ge=0,
        description="the input's poses are adjusted to the images where, at these poses, the features miss "
        "their points by more than this many pixels (median), and at the adjusted ones by at most half",
    )
    camera_model: SfmModel = Field(
        "SIMPLE_RADIAL", description="COLMAP camera model that SfM fits when the input brings no cameras"
    )
    shared_camera: bool = Field(
        True, description="SfM: one camera for all frames of a size; false: a camera a frame"
    )
    feature_size: int = Field(
        960, ge=64, description="long side at which features are found, px; never enlarged, at least max_size"
    )
    max_features: int = Field(
        4096, ge=256, le=65536, description="SIFT features a frame, the largest scales first"
    )
    exhaustive_below: int = Field(
        60,
        ge=0,
        description="all pairs are matched below this many frames, else neighbours and loop candidates",
    )
    overlap: int = Field(
        8,
        ge=1,
        le=100,
        description="each frame is matched with this many next ones, and with those 2, 4, 8, ... on",
    )
    loop_candidates: int = Field(
        6, ge=0, le=100, description="distant frames of similar content to match with each frame"
    )
    min_registered: float = Field(
        0.30, ge=0, le=1, description="share of frames that must get a pose, or the stage fails"
    )

    @field_validator("layout")
    @classmethod
    def _layout_is_known(cls, name: str) -> str:
        return require_known("layouts", name, ("auto",))

    @field_validator("holdout", mode="before")
    @classmethod
    def _a_number_may_be_a_name(cls, value: object) -> object:
        return str(value) if isinstance(value, int) and not isinstance(value, bool) else value

    @field_validator("holdout")
    @classmethod
    def _known_holdout(cls, value: str) -> str:
        # Letters before a colon are meant for a rule; a frame may be named by a time of day.
        if re.match(r"[A-Za-z]+:", value) and not re.fullmatch(r"(every|sharpest):[1-9]\d*", value):
            raise ValueError("expected none, every:N, sharpest:N or a list of frame names")
        if value in ("every:1", "sharpest:1"):
            raise ValueError(f"{value} would hold out every frame")
        if not value.strip(" ,"):
            raise ValueError("expected none, every:N, sharpest:N or a list of frame names")
        return value
