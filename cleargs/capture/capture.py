"""Types of a capture: its frames in order, the cameras and poses that the input brings, and its layout."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from cleargs.capture.config import CaptureConfig
from cleargs.files import External as External

if TYPE_CHECKING:
    from cleargs.capture.cameras import Intrinsics, Pose
    from cleargs.capture.model import SparseModel


@dataclass(frozen=True)
class SourceFrame:
    """One frame as the input has it."""

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
    """True where the input itself names it as a test view."""


@dataclass(frozen=True)
class Capture:
    """The chosen frames of an input, in trajectory order."""

    kind: str
    """video, images, colmap, llff, transforms, or what the layout of another package says."""
    frames: tuple[SourceFrame, ...]
    n_available: int
    """Frames in the input, before choosing."""
    model: SparseModel | None = None
    """The sparse model of a COLMAP project, where it has points."""
    hdr: str | None = None
    """``pq`` or ``hlg`` for an HDR video, which is tone-mapped."""
    stretch: tuple[float | None, float | None] = (None, None)
    """From where to where videos are taken, s; None: from the first, to the last frame."""
    notes: tuple[str, ...] = ()
    """What the user should know of how the input was read. They are shown as warnings."""

    @property
    def posed(self) -> bool:
        return any(frame.pose is not None for frame in self.frames)


class Layout(Protocol):
    """Reader of one kind of input; a module, say.

    Another package's layout is taken by name and needs no ``detect``.
    """

    def detect(self, source: Path, *, poses: bool) -> bool:
        """Return True if the input at ``source`` has this layout.

        Looks at names only; without ``poses``, files of poses count for nothing.
        """

    def externals(self, source: Path, config: CaptureConfig) -> Mapping[str, External]:
        """Role -> file, folder, or single files by name: all that is read.

        Looks at names only and imports nothing heavy: the runner asks this of every run, also of one with
        nothing to do. A missing input is left to `open_capture` to name.
        """

    def open_capture(self, source: Path, config: CaptureConfig) -> Capture:
        """The frames in trajectory order, at most ``config.max_frames``, with what is known of cameras and
        poses. Decodes no frame; changes nothing. Raises InputError.
        """
