"""The lens of a capture from its matches, in `cleargs.capture.adjustment`."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from PIL import Image

from cleargs.capture import adjustment
from cleargs.capture.camera_models import FIRST_LENS, FISHEYE, FULL_LENS, MODELS, SfmModel
from cleargs.capture.colmap import pycolmap
from cleargs.capture.database import set_cameras

from .conftest import FOCAL, Ingest

FRAMES, FEW = 12, 6
FULL = [1280.0, 1330.0, 512.0, 384.0, -0.2, 0.2, 0.004, -0.003]
SIMPLE = [1280.0, 512.0, 384.0, -0.1]


def capture(database: Path, lens: str, params: list[float]) -> pycolmap.Reconstruction:
    """Write the matches of a ring of cameras, 0.5 px off, and return their model with the first lens."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1,
        num_frames_per_rig=FRAMES,
        num_points3D=400,
        track_length=6,
        camera_model_id=getattr(pycolmap.CameraModelId, lens),
        camera_params=params,
        sensor_from_rig_translation_stddev=0.0,
        sensor_from_rig_rotation_stddev=0.0,
    )
    with pycolmap.Database.open(database) as opened:
        model = pycolmap.synthesize_dataset(options, opened)
        pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=0.5), model, opened)
    adjustment.set_lens(model, FIRST_LENS)
    return model


@pytest.mark.parametrize(("lens", "params"), [("OPENCV", FULL), ("SIMPLE_RADIAL", SIMPLE)])
def test_few_frames_measure_the_lens(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lens: str, params: list[float]
) -> None:
    """Half of the frames choose the lens; all of them are adjusted only to another one."""
    frames = []

    def triangulate(model: pycolmap.Reconstruction, database: Path) -> pycolmap.Reconstruction:
        frames.append(model.num_reg_images())
        set_cameras(database, list(model.cameras.values()))
        options = pycolmap.IncrementalPipelineOptions(num_threads=1, extract_colors=False)
        return pycolmap.triangulate_points(model, database, tmp_path, tmp_path, options=options)

    monkeypatch.setattr(adjustment, "_LENS_FRAMES", FEW)
    model = capture(tmp_path / "matches.db", lens, params)
    measured, _ = adjustment.Adjuster(tmp_path / "matches.db", triangulate).with_measured_lens(model)

    changed = lens == FULL_LENS
    assert frames == [FEW] * 3 + [FRAMES] * 2 * changed
    assert (measured is model) != changed
    assert adjustment.lens_of(measured) == lens
    assert measured.num_reg_images() == FRAMES
    if changed:  # found: 0.12 % off; the model began 2 % off
        assert np.allclose(measured.cameras[1].params[:2], params[:2], rtol=4e-3)


def test_a_wrong_focal_length_of_the_exif_is_left_out(images: Path, ingest: Ingest) -> None:
    for path in images.iterdir():
        exif = Image.Exif()
        exif.get_ifd(0x8769)[41989] = 900  # 23 times the true one
        Image.open(path).save(path, exif=exif.tobytes())
    done = ingest(images)
    assert done.result.summary["registered"] == 10
    assert done.result.summary["cameras"][0]["focal_px"] == pytest.approx(FOCAL, rel=0.05)
    assert any("EXIF" in line for line in done.warnings)


def test_the_models_that_sfm_fits_are_those_of_the_table() -> None:
    fitted = {name for name, facts in MODELS.items() if facts.fitted}
    assert {*get_args(SfmModel)} == {"auto", *fitted} and {FIRST_LENS, FULL_LENS, FISHEYE} <= fitted
    assert MODELS.keys() <= pycolmap.CameraModelId.__members__.keys()
