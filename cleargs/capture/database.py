"""COLMAP's database of a job: creation with ids by frame number, copies, and facts about its frames."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path

from cleargs.capture.colmap import pycolmap
from cleargs.capture.sfm_job import Job
from cleargs.media.image import stated_focal

_MAX_IMAGES = 2**31 - 1
"""COLMAP's number of a pair of images is the id of the first times this, plus the id of the second."""


def create_database(database: Path, job: Job) -> None:
    """Create ``database`` with cameras and images in frame order, so that ids do not depend on threads.

    Features that a killed run left in the database stay.
    """
    cameras = colmap_cameras(job)
    if database.exists():
        with pycolmap.Database.open(database) as opened:
            whole = opened.num_images() == len(job.names)
        if whole:
            return set_cameras(database, cameras)  # a killed run may have adjusted them
        remove_database(database)
    with pycolmap.Database.open(database) as opened, pycolmap.DatabaseTransaction(opened):
        for camera in cameras:
            opened.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=camera.camera_id)
            rig.add_ref_sensor(camera.sensor_id)
            opened.write_rig(rig, use_rig_id=True)
        for index, (name, number) in enumerate(zip(job.names, job.camera_of, strict=True)):
            shot = pycolmap.Image(name=name, camera_id=number + 1, image_id=index + 1)
            opened.write_image(shot, use_image_id=True)
            frame = pycolmap.Frame(frame_id=index + 1, rig_id=number + 1)
            frame.add_data_id(shot.data_id)
            opened.write_frame(frame, use_frame_id=True)


def copy_features(source: Path, target: Path) -> None:
    """Copy features and matches of all images from one database to another."""
    with closing(sqlite3.connect(target)) as opened:
        opened.execute("ATTACH ? AS source", (str(source),))
        for table in ("keypoints", "descriptors", "matches", "two_view_geometries"):
            opened.execute(f"INSERT OR REPLACE INTO {table} SELECT * FROM source.{table}")
        opened.commit()


def set_cameras(database: Path, cameras: Sequence[pycolmap.Camera]) -> None:
    with pycolmap.Database.open(database) as opened:
        for camera in cameras:
            opened.update_camera(camera)


def colmap_cameras(job: Job) -> list[pycolmap.Camera]:
    """Return the cameras of ``job``, with ids from 1 and the focal lengths in the EXIF of input images."""
    cameras = []
    for number, (known, image) in enumerate(zip(job.cameras, job.exif_images, strict=True)):
        camera = pycolmap.Camera(**asdict(known), camera_id=number + 1)
        if image is not None:
            apply_exif_focal(camera, image)
        if job.focal_known:
            camera.has_prior_focal_length = True
        cameras.append(camera)
    return cameras


def apply_exif_focal(camera: pycolmap.Camera, image: Path) -> None:
    """Set the focal length of ``camera`` to the one in the EXIF data of ``image``, if there is one."""
    factor = stated_focal(image)
    if factor is None:
        return
    params = list(camera.params)
    for index in camera.focal_length_idxs():
        params[index] = factor * max(camera.width, camera.height)
    camera.params = params
    camera.has_prior_focal_length = True


def is_sound(database: Path) -> bool:
    """Return True if every page of ``database`` is intact. COLMAP would abort at a damaged page."""
    try:
        with closing(sqlite3.connect(database)) as opened:
            return bool(opened.execute("PRAGMA integrity_check").fetchone() == ("ok",))
    except sqlite3.Error:
        return False


def remove_database(database: Path) -> None:
    """Remove the files of ``database``, including SQLite's log of changes."""
    for leftover in database.parent.glob(f"{database.name}*"):
        leftover.unlink()


def copy_without_features(database: Path, copy: Path, image_ids: Collection[int]) -> None:
    """Copy COLMAP's ``database`` without the features and matches of these images."""
    remove_database(copy)
    copy_database(database, copy)
    remove_features(copy, image_ids)


def copy_database(database: Path, copy: Path) -> None:
    with closing(sqlite3.connect(database)) as source, closing(sqlite3.connect(copy)) as target:
        source.backup(target)


def frames_with_few_features(database: Path, names: Collection[str], limit: float) -> dict[str, int]:
    """Return name -> id of images with fewer than ``limit`` features; nothing once pairs were matched."""
    with pycolmap.Database.open(database) as opened:
        if opened.num_matched_image_pairs():
            return {}
        ids = {image.name: image.image_id for image in opened.read_all_images() if image.name in names}
        return {name: key for name, key in ids.items() if opened.num_keypoints_for_image(key) < limit}


def remove_features(database: Path, image_ids: Collection[int]) -> None:
    """Remove the features and matches of these images from ``database``."""
    listed = ", ".join(str(int(image_id)) for image_id in image_ids)
    with closing(sqlite3.connect(database)) as target:
        for table in ("keypoints", "descriptors"):
            target.execute(f"DELETE FROM {table} WHERE image_id IN ({listed})")
        for table in ("matches", "two_view_geometries"):
            target.execute(
                f"DELETE FROM {table} WHERE pair_id / {_MAX_IMAGES} IN ({listed}) "
                f"OR pair_id % {_MAX_IMAGES} IN ({listed})"
            )
        target.commit()


def why_missing(database: Path, missing: Mapping[int, str]) -> dict[str, str]:
    """Return image name -> reason why COLMAP found no pose. ``missing`` is image id -> image name."""
    with pycolmap.Database.open(database) as opened:
        pair_ids, inliers = opened.read_two_view_geometry_num_inliers()
        features = {image_id: opened.num_keypoints_for_image(image_id) for image_id in missing}
    matched: set[int] = set()
    for pair_id, count in zip(pair_ids, inliers, strict=True):
        pair = pycolmap.pair_id_to_image_pair(pair_id)
        if count and any(image_id not in missing for image_id in pair):
            matched.update(pair)
    return {
        name: "too few points in common with placed frames"
        if image_id in matched
        else "matches no placed frame"
        if features[image_id]
        else "no features"
        for image_id, name in missing.items()
    }
