"""Job of the process that measures the camera's motion from tracks, and its outcome."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from cleargs.base_model import FrozenModel

OUTCOME, TRACKS, MOTIONS, ADJUSTED = "outcome.json", "tracks.npz", "motions.npz", "model"
"""Files in the folder of a job: its `MotionOutcome`, the tracks, the measured motions, the adjusted model."""


class MotionJob(FrozenModel):
    """Input: a sparse model, and in `TRACKS` the tracks of its frames.

    Each entry ``IMAGE.places`` [1 + K, P, 2], px of the working image, has its point ids ``IMAGE.points`` [P]
    and the times ``IMAGE.times`` [K] of the neighbours after the frame, s.
    """

    folder: Path
    model: Path
    given: bool
    """True if the poses and cameras are those of the input. They stay."""
    rolling_shutter: bool
    """False if no readout time is searched for."""
    lenses: dict[str, int]
    """Working image -> number of its lens: a camera of the model, in one video or folder."""


class LensReadout(FrozenModel):
    """Readout time of a lens, accepted (`Readout.holds`)."""

    lens: int
    seconds: float
    """Negative if the bottom row, or the right column, is read first. In frames if there is no clock."""
    interval: tuple[float, float]
    """Interval of 95 %."""
    columns: bool
    """True if the columns of the upright picture are read one after the other: a camera held sideways."""
    still_px: float
    """Mean error of the kept-out points without the readout, px."""
    rolled_px: float
    """Mean error with it, px."""


class MotionOutcome(FrozenModel):
    """Readout times that were found. If there are none, the model does not change."""

    readouts: list[LensReadout] = Field(default_factory=list)
