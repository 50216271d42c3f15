"""Settings of this package, which those of the stage `cleargs.stages.ingest` inherit."""

from __future__ import annotations

import math
import re
from typing import Literal

from pydantic import Field, field_validator

from cleargs.base_model import FrozenModel
from cleargs.capture.camera_models import SfmModel
from cleargs.plugins import require_known

_FOCAL, _DEGREES = re.compile(r"\s*(\d+\.?\d*|\.\d+)\s*(|px|deg|degrees|°)\s*"), ("deg", "degrees", "°")
_WIDEST = math.radians(170)  # field of view with which a perspective lens starts at most


class CaptureConfig(FrozenModel):
    """Settings for reading an input and choosing its frames."""

    fps: float | None = Field(
        None,
        gt=0,
        le=1000,
        description="frames per second to take from a video, each the sharpest nearby; unset: max_frames "
        "alone decides",
    )
    max_frames: int = Field(
        240,
        ge=3,
        description="most frames to take, evenly; in a video, the sharpest nearby, and evenly by the motion "
        "of the picture if the pace is uneven and fps is unset",
    )
    start: float | None = Field(
        None, ge=0, description="take a video from this time on, s; unset: from its first frame on"
    )
    end: float | None = Field(
        None, gt=0, description="take a video up to this time, s; unset: up to its last frame"
    )
    frame_rate: float | None = Field(
        None,
        gt=0,
        le=1000,
        description="frames per second of the video from which the images of a folder were taken, by their "
        "numbers; unset: times are in frames, and no readout is given in ms",
    )
    only: str | None = Field(
        None,
        coerce_numbers_to_str=True,
        description="take only these files of a folder: names, folders or patterns below it, separated by "
        "commas; unset: all",
    )
    skip: str | None = Field(None, description="leave out these files of a folder: like only; unset: none")
    layout: str = Field(
        "auto",
        json_schema_extra={"key": False, "plugin": "layouts"},  # the files that are read are in the key
        description="reader of the input; auto: chosen by the files in it; or a layout of another package",
    )
    poses: Literal["auto", "sfm"] = Field(
        "auto", description="auto: the input's poses where it has them; sfm: ignore its poses and cameras"
    )

    @property
    def uses_poses(self) -> bool:
        """True if poses in the input are used."""
        return self.poses == "auto"

    @field_validator("layout")
    @classmethod
    def _layout_is_known(cls, name: str) -> str:
        return require_known("layouts", name, ("auto",))


class SfmConfig(FrozenModel):
    """Settings for the search for poses and sparse points."""

    refine_above: float = Field(
        0.6,
        ge=0,
        description="poses and cameras of the input are adjusted to the images, or found again, if features "
        "miss their points by more than this many pixels (median) at the input's poses",
    )
    camera_model: SfmModel = Field(
        "auto",
        description="COLMAP camera model that SfM fits; auto: SIMPLE_RADIAL, or OPENCV if that lowers the "
        "error of matches that the fit did not use",
    )
    shared_camera: bool = Field(
        True,
        description="SfM: one camera for all frames of one size and lens, unless the focal length changes; "
        "false: a camera per frame",
    )
    focal: str | None = Field(
        None,
        coerce_numbers_to_str=True,
        description="SfM: focal length to start with, px of the input's images (450px), or field of view "
        "across the long side (65deg); unset: by EXIF, else a guess",
    )

    @field_validator("focal")
    @classmethod
    def _focal_is_a_length_or_an_angle(cls, value: str | None) -> str | None:
        if value is not None:
            found = _FOCAL.fullmatch(value)
            if not found or not 0 < float(found[1]) < (360 if found[2] in _DEGREES else 1e6):
                raise ValueError("expected a focal length such as 450px, or a field of view such as 65deg")
        return value

    def focal_share(self, model: str, long_side: int) -> float:
        """Return the ``focal`` that is set, in long sides of the image, for a camera ``model`` of COLMAP.

        ``long_side`` is that of the input's image, px. A field of view means another focal length in a
        fisheye.
        """
        found = _FOCAL.fullmatch(self.focal or "")
        assert found is not None  # as validated
        if found[2] not in _DEGREES:
            return float(found[1]) / long_side
        angle = math.radians(float(found[1]))
        return 1 / angle if "FISHEYE" in model else 0.5 / math.tan(min(angle, _WIDEST) / 2)

    max_features: int = Field(
        4096, ge=256, le=65536, description="SIFT features per frame, the largest scales first"
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
