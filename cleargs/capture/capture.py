"""Types of a capture: its frames in order, the cameras and poses of the input, and its layout."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from cleargs.capture.config import CaptureConfig
from cleargs.files import External as External

if TYPE_CHECKING:
    from cleargs.capture.cameras import Intrinsics, Pose
    from cleargs.capture.loose_points import LoosePoints
    from cleargs.capture.model import SparseModel


@dataclass(frozen=True)
class SourceFrame:
    """One frame of the input."""

    name: str
    path: Path
    """Image file, or the video."""
    pts: int | None = None
    """Presentation time stamp, for a frame of a video."""
    time_s: float | None = None
    mask: Path | None = None
    camera: Intrinsics | None = None
    pose: Pose | None = None
    test: bool = False
    """True if the input names it as a test view."""
    up: tuple[float, float, float] | None = None
    """Up in the axes of its camera (x right, y down, z ahead), where the input states it."""


@dataclass(frozen=True)
class Capture:
    """The chosen frames of an input, in trajectory order."""

    kind: str
    """``video``, ``images``, ``colmap``, ``llff``, ``transforms``, or the name of another package's
    layout."""
    frames: tuple[SourceFrame, ...]
    n_available: int
    """Frames in the input, before choosing."""
    model: SparseModel | None = None
    """The sparse model of a COLMAP project, where it has points."""
    loose: LoosePoints | None = None
    """Its points, if no image observes them."""
    hdr: str | None = None
    """``pq`` or ``hlg`` for an HDR video, which is tone-mapped."""
    stretch: tuple[float | None, float | None] = (None, None)
    """Start and end of the part of each video that is used, s. None: the first frame, the last frame."""
    available: tuple[SourceFrame, ...] = ()
    """All images of a folder in order, before choosing; empty for a video."""
    frame_rate: float | None = None
    """Images per second of a folder, if the user says so (`CaptureConfig.frame_rate`)."""
    told: str = ""
    """One line on what is read from a folder and what is left out."""
    notes: tuple[str, ...] = ()
    """Remarks on how the input was read."""

    @property
    def remarks(self) -> tuple[str, ...]:
        """Return `notes`, and one on the colours of an HDR video. All are shown as warnings."""
        if self.hdr is None:
            return self.notes
        toned = (
            f"HDR video ({self.hdr.upper()}): tone-mapped to sRGB, reference white (203 cd/m²) at 0.8, "
            "highlights compressed; record in SDR where colours must be exact"
        )
        return *self.notes, toned

    @property
    def has_clock(self) -> bool:
        """Return True if times between frames are known in seconds."""
        return self.kind == "video" or self.frame_rate is not None

    @property
    def posed(self) -> bool:
        """Return True if any frame has a pose."""
        return any(frame.pose is not None for frame in self.frames)


class Layout(Protocol):
    """Reader of one kind of input: a module, or an object with these methods.

    A layout of another package is chosen by name and needs no ``detect``.
    """

    def detect(self, source: Path, config: CaptureConfig) -> bool:
        """Return True if the files in ``source`` show this layout. Pose files count if the poses are used."""

    def externals(self, source: Path, config: CaptureConfig) -> Mapping[str, External]:
        """Return all files that are read, by role: a file, a folder, or single files by name.

        Imports nothing heavy: the runner calls it for every run. `open_capture` reports a missing input.
        """

    def open_capture(self, source: Path, config: CaptureConfig) -> Capture:
        """Return at most ``config.max_frames`` frames in trajectory order, with known cameras and poses.

        Decodes no frame and changes nothing. Raises InputError if the input is damaged or incomplete.
        """
