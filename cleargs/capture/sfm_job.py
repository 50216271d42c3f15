"""Job of COLMAP's process, and its outcome: what `cleargs.capture.sfm` and its child process exchange."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

from pydantic import Field

from cleargs.base_model import FrozenModel
from cleargs.capture.cameras import Intrinsics
from cleargs.capture.config import SfmConfig

OWN = "own"
"""Convention of an input's poses: the one of its layout."""

NO_DEPTH = (
    "the frames show no depth: the camera only turned or zoomed on one spot, or all that it shows is flat "
    "(a homography explains the matches of distant frames)"
)
LITTLE_DEPTH = "the frames show little depth: the camera moved too little"
MOVE = "move, do not only turn: walk around the subject, sideways, with things at different distances in view"
"""Causes and remedy if no frames, or few, differ by parallax (`cleargs.capture.parallax`)."""

OUTCOME = "outcome.json"
"""File in the folder of a model, with its `SfmOutcome`."""


GOOD_SHARE, LEAST_SHARE, STRANGE_SHARE, MIN_KEYPOINTS = 0.5, 0.25, 0.8, 100
"""Shares of the kept-out keypoints within 2 px below which ingest is done only in part, fails, and is done
only in part if the matches ask for a lens that is not believed; fewest keypoints that count."""
HALVES_APART = 0.01
"""`SfmOutcome.halves_apart` from which a warning is given, unless a readout explains it. Observed: at most
0.0034 of right cameras; 0.011 to 0.05 of cameras that skew or a second motion makes 5 to 39 % wrong
(docs/experiments/poses.md)."""
SECOND_MOTION, MUCH_MOTION, STILL_SHARE = 0.1, 0.5, 0.8
"""Shares of the pairs of frames with a second motion from which ingest is done only in part if the halves of
the pictures are `HALVES_APART`, or if fewer than the last share of the kept-out keypoints are within 2 px.
Patterns that repeat and blurred frames give 0.29 and 89 % in a room whose cameras are right."""


class Job(FrozenModel):
    """Input of COLMAP: working images, their cameras, the poses if they are known, and settings."""

    folder: Path
    images: Path
    masks: Path | None
    names: list[str]
    cameras: list[Intrinsics]
    camera_of: list[int]
    """Number of the camera of each image."""
    poses: dict[str, list[list[list[float]]]] | None
    """Convention that the input may mean -> matrices 3x4, world to camera, of all images."""
    exif_images: list[Path | None]
    """Input image of each camera that may state its focal length."""
    known_focal: Mapping[str, float] = Field(default_factory=dict)
    """Kind of lens -> focal length that the user states, in long sides."""
    focal_known: bool = False
    """True if the focal lengths of the cameras are stated by the user, or searched."""
    config: SfmConfig
    seed: int
    threads: int


class Prediction(FrozenModel):
    """Figure of the errors of cameras at keypoints of tracks that took no part in their fit."""

    keypoints: int
    share: float
    """Share within `cleargs.capture.prediction.WITHIN_PX`."""
    median_px: float


class SfmOutcome(FrozenModel):
    """Origin and errors of a model."""

    placed: Mapping[str, str] = Field(default_factory=dict)
    """Working image -> method by which its pose was found, or reason why there is none."""
    missed_px: float | None = None
    """Median reprojection error at the input's poses, px of the working images; None: it has no poses."""
    convention: str = OWN
    """The convention by which the input's poses fit the images."""
    method: Literal["given", "adjusted", "sfm"] = "given"
    """Origin of the poses: the input's, the input's after adjustment, or structure from motion."""
    errors_px: Mapping[str, float] = Field(default_factory=dict)
    """Method -> median distance of the kept-out matches from their epipolar lines, px."""
    prediction: Prediction | None = None
    """Figure of all frames; None: not measured, or there are none."""
    predictions: Mapping[str, Prediction] = Field(default_factory=dict)
    """The same by working image."""
    lens: str = ""
    """COLMAP model of the cameras that were adjusted; empty if no camera was adjusted."""
    focal_open: bool = False
    """True if the cameras look the same way, and their focal length is assumed (`capture.unturned`)."""
    strange_lens: bool = False
    """True if SfM found, or the matches ask for, a lens that is not believed (`lenses.is_impossible`)."""
    little_depth: bool = False
    """True if few pairs of frames show depth (`parallax.LITTLE_BELOW`)."""
    halves_apart: float = 0.0
    """Distance between the places of the camera by the upper and the lower half of the pictures, a share of
    the mean distance of the camera centres from their mean (`capture.frame_fit`)."""
    second_motion: float = 0.0
    """Share of the pairs of frames in which matches agree with each other, but not with the cameras
    (`capture.second_motion`)."""
    shifts_px: Mapping[str, tuple[float, float]] = Field(default_factory=dict)
    """Working image -> shift of its picture by a stabiliser, px; empty: none was found."""
    elsewhere: Sequence[str] = ()
    """Working images without a pose that fit each other, as after a cut to another place."""
    torn_at: int | None = None
    """Number of the first frame after a join that matches contradict (`weakest_join`); None: no such join."""
