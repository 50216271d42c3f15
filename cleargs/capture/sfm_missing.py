"""Frames that SfM did not place: their features forgotten for another try, and why there is no pose."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection
from contextlib import closing
from pathlib import Path

from cleargs.capture.colmap import pycolmap

_MAX_IMAGES = 2**31 - 1
"""COLMAP numbers a pair of images by the id of the first, times this, plus that of the second."""


def copy_without_features(database: Path, copy: Path, image_ids: Collection[int]) -> None:
    """Copy COLMAP's ``database`` but for the features of these images and their matches."""
    for leftover in copy.parent.glob(f"{copy.name}*"):
        leftover.unlink()
    listed = ", ".join(str(int(image_id)) for image_id in image_ids)
    with closing(sqlite3.connect(database)) as source, closing(sqlite3.connect(copy)) as target:
        source.backup(target)
        for table in ("keypoints", "descriptors"):
            target.execute(f"DELETE FROM {table} WHERE image_id IN ({listed})")
        for table in ("matches", "two_view_geometries"):
            target.execute(
                f"DELETE FROM {table} WHERE pair_id / {_MAX_IMAGES} IN ({listed}) "
                f"OR pair_id % {_MAX_IMAGES} IN ({listed})"
            )
        target.commit()


def why_missing(database: Path, missing: Collection[int]) -> dict[int, str]:
    """Why COLMAP gave none of the images of these ids a pose."""
    with pycolmap.Database.open(database) as opened:
        pair_ids, inliers = opened.read_two_view_geometry_num_inliers()
        features = {image_id: opened.num_keypoints_for_image(image_id) for image_id in missing}
    matched: set[int] = set()
    for pair_id, count in zip(pair_ids, inliers, strict=True):
        pair = pycolmap.pair_id_to_image_pair(pair_id)
        if count and any(image_id not in features for image_id in pair):
            matched.update(pair)
    return {
        image_id: "too few points in common with placed frames"
        if image_id in matched
        else "matches no placed frame"
        if count
        else "no features"
        for image_id, count in features.items()
    }
