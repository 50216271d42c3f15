"""MAXIM from its TensorFlow.js release: equality with the reference vectors, before and after fusion."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from cleargs.models.convert import maxim
from cleargs.models.convert.onnx_file import write_onnx
from cleargs.models.convert.rewrite import in_order
from cleargs.models.expert import OnnxExpert
from cleargs.models.onnx import OnnxModel
from cleargs.models.registry import find_model

ROOT = Path(__file__).parents[2]
SHARED = Path(os.environ.get("CLEARGS_CAPTURES", ROOT.parent / "shared" / "captures")).parent / "models"
VECTORS = SHARED / "maxim_gopro_stage1_io.npz"


@pytest.fixture(scope="module")
def package() -> bytes:
    """The published npm package; it is 84 MB, so only a copy that is already there is used."""
    source = find_model("maxim-gopro").source
    assert source is not None
    folder = os.environ.get("CLEARGS_MODEL_SOURCES")
    path = Path(folder) / source.file if folder else None
    if path is None or not path.is_file():
        pytest.skip(f"CLEARGS_MODEL_SOURCES names no folder with {source.file} (npm pack)")
    return path.read_bytes()


def test_the_first_stage_equals_the_reference(package: bytes, tmp_path: Path) -> None:
    if not VECTORS.is_file():
        pytest.skip(f"{VECTORS.name} is not there")
    vectors = np.load(VECTORS)
    maxim.convert(package, 1, tmp_path / "maxim.onnx")
    model = OnnxModel(tmp_path / "maxim.onnx")
    restored = model.run(vectors["input_nhwc"])[0].transpose(0, 3, 1, 2)
    # float32 in another order of operations: 2e-6 here
    np.testing.assert_allclose(restored, vectors["output_nchw"], atol=1e-4)
    assert model.digest == find_model("maxim-gopro").files[0].digest
    assert OnnxExpert(tmp_path / "maxim.onnx").restore(vectors["input_nhwc"][0]).shape == (256, 256, 3)


@pytest.mark.parametrize("stage", [2, 3])
def test_later_stages_equal_the_graph_as_it_was_published(package: bytes, stage: int, tmp_path: Path) -> None:
    # At tiles of 64, a sixteenth of the work; the graph's shapes follow the tile.
    spelt_out = maxim.network(package, stage, tile=64)
    write_onnx(tmp_path / "plain.onnx", spelt_out, input_name="image", output_name="restored", metadata={})
    maxim.convert(package, stage, tmp_path / "fused.onnx", tile=64)
    image = np.random.default_rng(stage).random((1, 64, 64, 3), np.float32)
    plain = OnnxModel(tmp_path / "plain.onnx").run(image)[0]
    fused = OnnxModel(tmp_path / "fused.onnx").run(image)[0]
    assert np.abs(plain - image).max() > 0.01  # it does something
    np.testing.assert_allclose(fused, plain, atol=1e-4)


def test_fusion_leaves_no_spelt_out_operator(package: bytes) -> None:
    from cleargs.models.convert.fuse import fused

    operators = [node.op for node in in_order(fused(maxim.network(package, 1)))]
    # 108 layer norms, 64 gated units (54 of them on both halves), 12 leaky units: none is left in pieces
    assert operators.count("LayerNormalization") == 108
    assert not {"Tanh", "Where", "GreaterOrEqual", "Sqrt", "Slice", "Concat"} & set(operators)
