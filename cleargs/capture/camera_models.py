"""The camera models that ClearGS reads, in one table. `SfmModel` repeats the names of fitted ones."""

from __future__ import annotations

from typing import Literal, NamedTuple

SfmModel = Literal["auto", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"]
"""Models that SfM fits: those that are ``fitted`` in `MODELS`, and the choice by the images."""

FIRST_LENS, FULL_LENS, FISHEYE = "SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE"
"""Models that ``auto`` tries: one focal length and one radial term; two focal lengths, two radial and two
tangential terms; a fisheye."""


class CameraModel(NamedTuple):
    """Facts about a camera model of COLMAP."""

    fisheye: bool = False
    """It bends straight lines even if all distortion terms are 0."""
    fitted: bool = False
    """SfM may fit it (``ingest.camera_model``)."""
    simple: bool = False
    """It has no distortion terms that `FIRST_LENS` lacks."""
    transforms: tuple[str, ...] = ()
    """Its names in ``transforms.json``."""


MODELS = {
    "SIMPLE_PINHOLE": CameraModel(fitted=True, simple=True, transforms=("SIMPLE_PINHOLE",)),
    "PINHOLE": CameraModel(fitted=True, simple=True, transforms=("PINHOLE", "PERSPECTIVE")),
    "SIMPLE_RADIAL": CameraModel(fitted=True, simple=True, transforms=("SIMPLE_RADIAL",)),
    "RADIAL": CameraModel(fitted=True, transforms=("RADIAL",)),
    "OPENCV": CameraModel(fitted=True, transforms=("OPENCV",)),
    "FULL_OPENCV": CameraModel(),
    "OPENCV_FISHEYE": CameraModel(fisheye=True, fitted=True, transforms=("OPENCV_FISHEYE", "FISHEYE")),
    "SIMPLE_RADIAL_FISHEYE": CameraModel(fisheye=True),
    "RADIAL_FISHEYE": CameraModel(fisheye=True),
    "THIN_PRISM_FISHEYE": CameraModel(fisheye=True),
    "FOV": CameraModel(fisheye=True),
}
"""Name in COLMAP -> its facts."""
SIMPLE = frozenset(name for name, model in MODELS.items() if model.simple)
BY_TRANSFORMS = {given: model for model in MODELS.values() for given in model.transforms}
"""Name in ``transforms.json`` -> facts about the model."""
