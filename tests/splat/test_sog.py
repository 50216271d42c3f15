"""``.sog``, read by gsply."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from test_compressed_ply import make

from cleargs.splat.compressed_ply import morton_order
from cleargs.splat.scene import Scene
from cleargs.splat.sog import codebook, nearest, palette, sog

gsply = pytest.importorskip("gsply")
pytest.importorskip("imagecodecs")  # gsply needs it to read WebP


@pytest.mark.parametrize(("count", "sh_degree"), [(1, 0), (60, 1), (1000, 2), (2100, 3)])
def test_another_reader_finds_the_same_scene(count: int, sh_degree: int, tmp_path: Path) -> None:
    made = make(count, sh_degree)
    made.logit_opacities.clamp_(min=-5.0)  # Gaussians with alpha 0 have no colour in the file
    (tmp_path / "a.sog").write_bytes(sog(Scene(made)))
    back = gsply.sogread(str(tmp_path / "a.sog"))
    made = made.select(torch.from_numpy(morton_order(made.means.numpy())))
    # Half a step of 16 bits over the range of log(1 + |x|), which spans less than 6, at |x| below 20.
    assert np.abs(back.means - made.means.numpy()).max() < 6 / 2**16 / 2 * 21
    # 256 numbers over a range of 3 (colours) to 8: finer than uniform steps on average, coarser in places.
    for read, wrote in ((back.scales, made.log_scales.numpy()), (back.sh0, made.sh[:, 0].numpy())):
        step = max(float(np.ptp(wrote)), 1.0) / 255
        assert np.abs(read - wrote).mean() < step / 4 and np.abs(read - wrote).max() < 6 * step
    alpha = 1 / (1 + np.exp(-back.opacities.astype(np.float64)))
    assert np.abs(alpha - torch.sigmoid(made.logit_opacities).numpy()).max() < 0.5 / 255 + 1e-3
    unit = torch.nn.functional.normalize(made.rotations).numpy()
    assert np.abs(np.abs((back.quats * unit).sum(axis=1)) - 1.0).max() < 1e-4  # 8 bits of each part
    if sh_degree:  # palette sizes are multiples of 1024, so nearly every Gaussian has its own vector
        assert np.abs(back.shN - made.sh[:, 1:].numpy()).mean() < (0.02 if count < 2048 else 0.06)


def test_bytes_do_not_depend_on_the_order_of_gaussians() -> None:
    made = make(300, 1)
    shuffled = made.select(torch.randperm(300, generator=torch.Generator().manual_seed(0)))
    assert sog(Scene(made)) == sog(Scene(shuffled))


def test_antialiasing_is_stored(tmp_path: Path) -> None:
    for antialias in (False, True):
        (tmp_path / "a.sog").write_bytes(sog(Scene(make(5, 0), antialias=antialias)))
        with zipfile.ZipFile(tmp_path / "a.sog") as archive:
            assert {entry.compress_type for entry in archive.infolist()} == {zipfile.ZIP_STORED}
            assert (json.loads(archive.read("meta.json")).get("model") == "antialiased") == antialias


def test_a_codebook_fits_clusters_and_outliers() -> None:
    chance = np.random.default_rng(0)
    crowd = chance.normal(0.0, 0.01, 5000).astype(np.float32)
    values = np.concatenate([crowd, np.array([-9.0, 7.0], np.float32)])
    centres = codebook(values, 256)
    assert (np.diff(centres) >= 0).all() and len(centres) == 256
    off = np.abs(centres[nearest(centres, values)] - values)
    assert off[:5000].mean() < 5e-4 and off[5000:].max() < 0.05
    same = codebook(np.full(10, 2.5, np.float32), 256)
    assert (same == 2.5).all()


def test_a_palette_finds_clusters() -> None:
    chance = np.random.default_rng(0)
    centres = np.array([[0.0, 0], [5, 5], [-5, 5]], np.float32)
    which = chance.integers(0, 3, 900)
    vectors = (centres[which] + chance.normal(0, 0.01, (900, 2))).astype(np.float32)
    found, labels = palette(vectors, 3)
    assert np.abs(found[labels] - centres[which]).max() < 0.1
    few, labels = palette(np.repeat(centres, 4, axis=0), 100)  # only different vectors
    assert len(few) == 3 and np.array_equal(few[labels], np.repeat(centres, 4, axis=0))
