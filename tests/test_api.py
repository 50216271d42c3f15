"""The Python API: its names, its imports and its errors."""

from __future__ import annotations

import ast
import inspect
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import cleargs as cg
from cleargs.errors import InputError

ROOT = Path(__file__).parents[1]


def test_every_name_is_there_and_the_stub_says_the_same() -> None:
    stub = ast.parse((ROOT / "cleargs" / "__init__.pyi").read_text())
    named = [alias.asname for node in stub.body if isinstance(node, ast.ImportFrom) for alias in node.names]
    assert sorted(filter(None, named)) == sorted(cg.__all__)
    for node in stub.body:
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                found = getattr(cg, alias.name)
                assert found.__module__ == node.module and inspect.getdoc(found)
    assert set(cg.__all__) <= set(dir(cg))
    with pytest.raises(AttributeError, match="nothing_such"):
        cg.nothing_such  # noqa: B018


def test_the_import_loads_nothing_heavy() -> None:
    """Neither `import cleargs` nor reading the tables of a run imports heavy libraries."""
    code = (
        "import sys, cleargs as cg; assert not {'numpy', 'pydantic', 'torch'} & set(sys.modules);"
        "cg.run, cg.open_run, cg.Run;"
        "heavy = {'torch', 'numba', 'pycolmap', 'cv2', 'onnxruntime', 'OpenImageIO'};"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_training_needs_no_capture_libraries() -> None:
    code = (
        "import sys; sys.modules.update({'pycolmap': None, 'OpenImageIO': None});"
        "import cleargs as cg; cg.train, cg.render_view, cg.save, cg.load, cg.Scene, cg.TrainingView;"
        "import cleargs.splat.formats, cleargs.splat.training"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_missing_run_or_stage_is_an_error_with_a_hint(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is not a run"):
        cg.open_run(tmp_path)
    with pytest.raises(InputError, match="there is no stage"):
        cg.Run(tmp_path)["rvaa"]
    with pytest.raises(InputError, match="rva is not finished") as caught:
        cg.Run(tmp_path)["rva"]
    assert "cleargs status" in caught.value.hint
    with pytest.raises(InputError, match="there is no stage 'rvaa'"):
        cg.run(tmp_path, tmp_path / "run", until="rvaa")
    with pytest.raises(InputError, match=r"there is no setting rva\.tau"):
        cg.run(tmp_path, tmp_path / "run", set={"rva.tau": 0.5})
    with pytest.raises(InputError, match=r"rva\.tau_R = 'high' cannot be used"):
        cg.run(tmp_path, tmp_path / "run", set={"rva.tau_R": "high"})
    with pytest.raises(InputError, match="nothing to compare with"):
        cg.evaluate_scene(tmp_path / "scene.ply")


def test_an_image_is_scored_alike_in_bytes_and_in_floats() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
    floats = image.astype(np.float32) / np.float32(255)
    in_bytes = cg.score(image, scorer="naturalness-stats")
    assert in_bytes == cg.score(floats, scorer="naturalness-stats") and 0 <= in_bytes <= 100
