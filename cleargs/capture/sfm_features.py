"""Features of frames, and matches between them: the first steps of COLMAP's process."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np

from cleargs.capture.colmap import pycolmap
from cleargs.capture.database import (
    copy_features,
    create_database,
    frames_with_few_features,
    remove_database,
    remove_features,
)
from cleargs.capture.matching import loop_pairs, match_pairs, sequential_pairs
from cleargs.capture.sfm_job import Job


@dataclass(frozen=True)
class FeatureSettings:
    """Settings of features, and of the placement of frames by these features."""

    name: str
    """Value of ``placed`` for frames that these features placed."""
    reduced: int = 1
    """Maximum long side of an image: the long side of the largest image, divided by this."""
    contrast: float = 0.02 / 3
    inliers: int = 30
    """Fewest points of the model that must fit the pose of a frame."""
    neighbours: bool = False
    """Placed frames within ``overlap`` of a frame that is left out get new features too. Otherwise the chain
    of matches breaks where frames are dark or the camera turns."""


FIRST = FeatureSettings("sfm")  # COLMAP's defaults
_FEW_FEATURES, _FAINT = 0.25, 0.002
"""Frames with fewer features than this share of ``max_features`` get features down to this contrast at once:
dark and plain frames, in which COLMAP finds few or none (docs/experiments/poses.md)."""
AGAIN = (
    FeatureSettings("sfm at half resolution", reduced=2, contrast=0.002, inliers=15),
    FeatureSettings("sfm with fainter features", neighbours=True, contrast=0.001, inliers=15),
)
"""Settings for frames that were left out, tried in this order. A blur of 24 px at 480 px is half as long at
half the size, and the contrast that it leaves is enough (docs/experiments/poses.md). Affine-shape features
and guided matching place no more of these frames."""


class Features:
    """The steps of a job that find and match features in its database."""

    def __init__(self, job: Job, report: Callable[..., None]) -> None:
        self.job = job
        self._report = report
        self.database = job.folder / "database.db"

    def extract(self, database: Path, names: Sequence[str], settings: FeatureSettings) -> None:
        """Find SIFT features in the working images. COLMAP skips frames that already have features.

        Frames in which ``settings`` find few features get fainter ones too, unless a killed run has already
        matched pairs.
        """
        job = self.job
        limit = _FEW_FEATURES * job.config.max_features if settings.contrast > _FAINT else 0
        options = pycolmap.FeatureExtractionOptions(num_threads=job.threads, use_gpu=False)
        largest = max(max(camera.width, camera.height) for camera in job.cameras)
        options.max_image_size = largest // settings.reduced
        options.sift.max_num_features = job.config.max_features
        options.sift.peak_threshold = settings.contrast
        reader = pycolmap.ImageReaderOptions()
        if job.masks is not None:
            reader.mask_path = job.masks
        again = "" if settings == FIRST else " again"
        self._report(phase=f"finding features{again}", total=len(names))
        size = 4 * job.threads
        faint = copy.deepcopy(options)
        faint.sift.peak_threshold = _FAINT

        def find(where: Path, which: Sequence[str], how: pycolmap.FeatureExtractionOptions) -> None:
            if which:
                pycolmap.extract_features(
                    where, job.images, image_names=which, reader_options=reader, extraction_options=how
                )

        few_before = False
        for start in range(0, len(names), size):
            block = list(names[start : start + size])
            # A frame with few features down to the fainter contrast has few down to the usual one, too. So
            # after a block with few in all its frames, the fainter ones are found first.
            known = self._few_faint(database, block, limit, partial(find, how=faint)) if few_before else set()
            rest = [name for name in block if name not in known]
            find(database, rest, options)
            few = frames_with_few_features(database, rest, limit)
            if few:
                remove_features(database, few.values())
                find(database, [*few], faint)
            few_before = len(few) + len(known) == len(block)
            self._report(done=start + len(block))

    def _few_faint(
        self, database: Path, block: Sequence[str], limit: float, find: Callable[[Path, Sequence[str]], None]
    ) -> set[str]:
        """Write the fainter features of the frames in ``block`` that have few of them to ``database``.

        Returns the names of these frames. ``find`` finds features. It works in a copy, so that a killed run
        leaves no fainter features in frames with many.
        """
        scratch = database.with_name(f"{database.stem}-faint.db")
        create_database(scratch, self.job)
        find(scratch, block)
        few = frames_with_few_features(scratch, block, limit)
        many = frames_with_few_features(scratch, [name for name in block if name not in few], np.inf)
        remove_features(scratch, many.values())
        copy_features(scratch, database)
        remove_database(scratch)
        return set(few)

    def match(self, database: Path, pairs: Sequence[tuple[int, int]], again: str = "") -> None:
        """Match the features of ``pairs`` and keep the verified matches in ``database``."""
        self._report(phase=f"matching{again}", total=len(pairs))
        names, seed, threads = self.job.names, self.job.seed, self.job.threads
        match_pairs(database, names, pairs, seed, threads, lambda number: self._report(done=number))

    def pairs(self) -> list[tuple[int, int]]:
        """Return all pairs of frames, or neighbours and distant frames that look alike."""
        frames, config = len(self.job.names), self.job.config
        if frames < config.exhaustive_below:
            return list(combinations(range(frames), 2))
        near = sequential_pairs(frames, config.overlap)
        if not config.loop_candidates:
            return near
        self._report(phase="looking for loops", total=None)
        with pycolmap.Database.open(self.database) as opened:
            descriptors = [np.asarray(opened.read_descriptors(index + 1).data) for index in range(frames)]
        loops = loop_pairs(descriptors, config.loop_candidates, 2 * config.overlap, self.job.seed)
        return sorted({*near, *loops})
