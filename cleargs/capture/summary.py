"""The figures of ingest in its manifest."""

from __future__ import annotations

from typing import Any, Literal

from cleargs.manifest import Summary


class IngestSummary(Summary):
    """Figures of ingest; those of `cleargs.capture.measuring` are next to them."""

    kind: str | None = None
    """Layout of the capture."""
    input: str | None = None
    """Sentence on the files that were read and left out."""
    poses: Literal["given", "adjusted", "sfm"] | None = None
    """Poses of the input, the same after an adjustment, or poses of structure from motion."""
    given_poses_missed_px: float | None = None
    pose_convention: str | None = None
    kept_out_matches_off_px: dict[str, float] | None = None
    """Origin of poses -> median error of matches that the fit did not use, px."""
    kept_out: dict[str, Any] | None = None
    """A `cleargs.capture.sfm_job.Prediction`."""
    cameras: list[dict[str, Any]] | None = None
    """Lens, focal length and number of frames of each camera."""
    frames: int | None = None
    frames_available: int | None = None
    registered: int | None = None
    placed: dict[str, int] | None = None
    """Way in which frames were placed -> their number."""
    test: int | None = None
    holdout_hash: str | None = None
    points: int | None = None
    observations: int | None = None
    mean_reprojection_error_px: float | None = None
    up: str | None = None
