"""Features of frames, of which plain ones get fainter features."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from cleargs.capture.cameras import guessed_camera
from cleargs.capture.colmap import pycolmap
from cleargs.capture.config import SfmConfig
from cleargs.capture.database import create_database
from cleargs.capture.sfm_features import FIRST, Features
from cleargs.capture.sfm_job import Job

from .conftest import texture

SIZE = (200, 150)


def found(folder: Path, images: Path, threads: int) -> list[tuple[int, bytes, bytes]]:
    """Return number, keypoints and descriptors of the features of each frame."""
    names = sorted(path.name for path in images.iterdir())
    folder.mkdir()
    job = Job(
        folder=folder,
        images=images,
        masks=None,
        names=names,
        cameras=[guessed_camera("SIMPLE_RADIAL", *SIZE)],
        camera_of=[0] * len(names),
        poses=None,
        exif_images=[None],
        config=SfmConfig(max_features=1000),
        seed=0,
        threads=threads,
    )
    features = Features(job, lambda **_: None)
    create_database(features.database, job)
    features.extract(features.database, names, FIRST)
    assert [path.name for path in folder.iterdir()] == [features.database.name]
    with pycolmap.Database.open(features.database) as opened:
        rows = [
            (np.asarray(opened.read_keypoints(key)), np.asarray(opened.read_descriptors(key).data))
            for key in range(1, len(names) + 1)
        ]
    return [(len(keypoints), keypoints.tobytes(), descriptors.tobytes()) for keypoints, descriptors in rows]


def test_features_do_not_depend_on_the_frames_before(tmp_path: Path) -> None:
    """After plain frames, fainter features are found first: four frames at a time, or sixteen."""
    images = tmp_path / "images"
    images.mkdir()
    for number in range(8):
        picture = cv2.resize(texture(number), SIZE, interpolation=cv2.INTER_AREA)
        if number != 5:
            plain = cv2.GaussianBlur(picture, (0, 0), 4.0).astype(np.float32)
            picture = np.rint(118 + 0.3 * (plain - 118)).astype(np.uint8)
        cv2.imwrite(str(images / f"{number:02d}.png"), picture)
    four, sixteen = (found(tmp_path / f"by{threads}", images, threads) for threads in (1, 4))
    assert four == sixteen
    counts = [count for count, _, _ in four]
    assert 0 < max(counts[:4]) < 250 <= counts[5]
