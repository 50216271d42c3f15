"""Converted ONNX files equal PyTorch, for random weights of the real architectures.

Most tests need the environment of `make convert-env`; `make test-convert` runs them.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from torch import nn

from cleargs.errors import InputError
from cleargs.models.expert import OnnxExpert, load_expert
from cleargs.models.registry import find_model, read_receipt, verify
from cleargs.models.scorer import LearnedScorer, MusiqScorer, patches
from tools.convert_models import __main__ as convert_command
from tools.convert_models import restorer, scorers, torch_export
from tools.convert_models.__main__ import install_checkpoint, main
from tools.convert_models.torch_export import declare_torchvision_operators, require

SIZES = [(270, 480), (200, 90), (64, 300)]  # landscape, portrait, a strip

needs_spandrel = pytest.mark.skipif(
    find_spec("spandrel_extra_arches") is None or find_spec("onnxscript") is None,
    reason="spandrel is not installed (make convert-env)",
)
needs_pyiqa = pytest.mark.skipif(
    find_spec("pyiqa") is None or find_spec("onnxscript") is None,
    reason="pyiqa is not installed (make convert-env)",
)


def checkpoint(network: nn.Module, key: str | None = None) -> bytes:
    buffer = io.BytesIO()
    torch.save({key: network.state_dict()} if key else network.state_dict(), buffer)
    return buffer.getvalue()


def image(height: int, width: int) -> np.ndarray[Any, np.dtype[np.float32]]:
    return np.random.default_rng([height, width]).random((height, width, 3), np.float32)


# --- restorers --------------------------------------------------------------------------------------------


def restormer() -> nn.Module:
    from spandrel_extra_arches.architectures.Restormer.__arch.restormer_arch import Restormer

    return Restormer(dim=8, num_blocks=[1, 1, 1, 1], num_refinement_blocks=1, heads=[1, 2, 4, 8])


def nafnet() -> nn.Module:
    from spandrel.architectures.NAFNet.__arch.NAFNet_arch import NAFNet

    network = NAFNet(width=8, middle_blk_num=1, enc_blk_nums=[1, 1, 1, 2], dec_blk_nums=[1, 1, 1, 1])
    for name, weights in network.named_parameters():
        if name.endswith(("beta", "gamma")):  # initially zero, which would not change the image
            nn.init.normal_(weights)
    return network


@needs_spandrel
@pytest.mark.parametrize(("build", "key"), [(restormer, "params"), (nafnet, None)])
def test_restorers_equal_torch(build: Callable[[], nn.Module], key: str | None, tmp_path: Path) -> None:
    declare_torchvision_operators()
    torch.manual_seed(0)
    network = build().eval()
    restorer.convert(checkpoint(network, key), tmp_path / "restorer.onnx", tile=64)
    tile = image(64, 64)
    with torch.no_grad():
        expected = network(torch.from_numpy(tile).permute(2, 0, 1)[None])[0].permute(1, 2, 0).numpy()
    assert np.abs(expected - tile).max() > 0.05  # the network changes the image
    restored = OnnxExpert(tmp_path / "restorer.onnx").restore(tile)
    # float32 with another order of operations; 2e-7 measured for Restormer
    np.testing.assert_allclose(restored, expected.clip(0, 1), atol=1e-5)


@needs_spandrel
def test_restormer_installs_under_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    declare_torchvision_operators()
    monkeypatch.setenv("CLEARGS_MODELS", str(tmp_path / "models"))
    torch.manual_seed(0)
    file = tmp_path / "motion_deblurring.pth"
    file.write_bytes(checkpoint(restormer(), "params"))
    result = CliRunner().invoke(main, ["restormer-motion", str(file), "--accept-licence"])
    assert result.exception is None, result.exception
    expert = load_expert("restormer-motion")
    assert expert.name == "restormer-motion"
    verify(find_model("restormer-motion"), tmp_path / "models")


@needs_spandrel
def test_any_checkpoint_converts_to_a_file(tmp_path: Path) -> None:
    torch.manual_seed(0)
    (tmp_path / "own.pth").write_bytes(checkpoint(nafnet()))
    arguments = [str(tmp_path / "own.onnx"), str(tmp_path / "own.pth"), "--tile", "64"]
    result = CliRunner().invoke(main, arguments)
    assert result.exception is None, result.exception
    restored = load_expert(str(tmp_path / "own.onnx")).restore(image(70, 100))
    assert restored.shape == (70, 100, 3)


@needs_spandrel
@pytest.mark.parametrize("data", [b"", b"no checkpoint", checkpoint(nn.Linear(3, 4))])
def test_other_files_are_refused(data: bytes, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a checkpoint of a known architecture") as caught:
        restorer.convert(data, tmp_path / "restorer.onnx")
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_missing_packages_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="needs no_such_package") as caught:
        require("json", "no_such_package", purpose="converting")
    assert "make convert-env" in caught.value.hint

    monkeypatch.setattr(torch_export, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="converting musiq needs pyiqa"):  # raised before the file is read
        install_checkpoint(find_model("musiq"), tmp_path, tmp_path / "none.pth", licence_accepted=True)


# --- installation -----------------------------------------------------------------------------------------


@pytest.fixture
def converted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the converter by one that needs no package."""

    def convert(data: bytes, path: Path, *_: object) -> None:
        path.write_bytes(b"converted " + data)

    monkeypatch.setattr(convert_command, "require", lambda *packages, purpose: None)
    monkeypatch.setattr(restorer, "convert", convert)


@pytest.mark.parametrize("name", ["restormer-motion", "musiq", "clip-iqa"])
def test_licence_must_be_accepted(name: str, tmp_path: Path, converted: None) -> None:
    (tmp_path / "file").write_bytes(b"")
    refused = CliRunner().invoke(main, [name, str(tmp_path / "file"), "--dir", str(tmp_path / "models")])
    assert isinstance(refused.exception, InputError)
    assert "--accept-licence" in refused.exception.hint
    assert find_model(name).licence in refused.stderr and find_model(name).licence in str(refused.exception)
    assert not (tmp_path / "models").exists()


def test_other_checkpoint_is_refused(tmp_path: Path, converted: None) -> None:
    (tmp_path / "file").write_bytes(b"something else")
    with pytest.raises(InputError, match="SHA-256 differs"):
        install_checkpoint(find_model("musiq"), tmp_path / "models", tmp_path / "file", licence_accepted=True)


def test_receipt_holds_the_digests(tmp_path: Path, converted: None) -> None:
    checkpoint = tmp_path / "motion_deblurring.pth"
    checkpoint.write_bytes(b"weights")
    model, folder = find_model("restormer-motion"), tmp_path / "models"
    written = install_checkpoint(model, folder, checkpoint, licence_accepted=True)
    assert [path.name for path in written] == ["restormer-motion.onnx", "restormer-motion.receipt.json"]
    verify(model, folder)
    receipt = json.loads(written[1].read_text("utf-8"))
    assert receipt["source_sha256"] == hashlib.sha256(b"weights").hexdigest()

    written[0].write_bytes(b"converted otherwise")
    with pytest.raises(InputError, match="damaged"):
        verify(model, folder)
    written[1].write_text("[]", "utf-8")
    assert read_receipt(model, folder) == {}
    with pytest.raises(InputError, match="damaged"):
        verify(model, folder)


# --- scorers ----------------------------------------------------------------------------------------------


@needs_pyiqa
def test_musiq_equals_pyiqa(tmp_path: Path) -> None:
    declare_torchvision_operators()
    from pyiqa.archs.musiq_arch import MUSIQ

    torch.manual_seed(0)
    network = MUSIQ(pretrained=False).eval()
    scorers.convert("musiq", checkpoint(network), tmp_path / "musiq.onnx")
    scorer = MusiqScorer(tmp_path / "musiq.onnx")
    scores = []
    for size in SIZES:
        with torch.no_grad():
            expected = network(torch.from_numpy(image(*size)).permute(2, 0, 1)[None]).item()
        scores.append(expected)
        assert scorer.score(image(*size)) == pytest.approx(expected, abs=1e-5)  # 6e-7 measured
    assert np.ptp(scores) > 0.01  # the image matters
    assert scorer.score(image(64, 300), threads=2) == scorer.score(image(64, 300))


@needs_pyiqa
@pytest.mark.parametrize("size", [*SIZES, (333, 1000), (32, 32)])
def test_patches_equal_those_of_pyiqa(size: tuple[int, int]) -> None:
    from pyiqa.data.multiscale_trans_util import get_multiscale_patches

    planes = torch.from_numpy(image(*size)).permute(2, 0, 1)[None]
    tokens = get_multiscale_patches((planes - 0.5) * 2, 32, 32, 10, [224, 384], -1)[0].numpy()
    tokens = tokens[tokens[:, -1] > 0]  # the rest is padding to a fixed length
    pixels, places, scales = patches(image(*size))
    np.testing.assert_allclose(pixels.reshape(len(pixels), -1), tokens[:, :-3], atol=1e-6)
    np.testing.assert_array_equal(places, tokens[:, -3])
    np.testing.assert_array_equal(scales, tokens[:, -2])


@needs_pyiqa
def test_clip_iqa_equals_pyiqa(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    declare_torchvision_operators()
    from pyiqa.archs import clip_model, clipiqa_arch

    torch.manual_seed(0)
    # RN50 and the text encoder with fewer and narrower layers; all 49,408 tokens.
    clip = clip_model.CLIP(64, 64, (1, 1, 1, 1), 16, 0, 77, 49408, 64, 1, 2).eval()
    for weights in clip.visual.parameters():
        if not weights.any():  # some normalisations are initially zero, which would disable branches
            nn.init.normal_(weights, std=0.3)
    monkeypatch.setattr(clipiqa_arch, "load", lambda backbone, device: clip)  # avoids a download of CLIP
    network = clipiqa_arch.CLIPIQA().eval()
    scorers.convert("clip-iqa", b"", tmp_path / "clip-iqa.onnx")
    scorer = LearnedScorer(tmp_path / "clip-iqa.onnx")
    scores = []
    for size in SIZES:
        with torch.no_grad():
            expected = 100 * network(torch.from_numpy(image(*size)).permute(2, 0, 1)[None]).item()
        scores.append(expected)
        assert scorer.score(image(*size)) == pytest.approx(
            expected, abs=1e-4
        )  # scores are 0 to 100; 1e-5 measured
    assert np.ptp(scores) > 0.01


@needs_pyiqa
@pytest.mark.parametrize("kind", ["musiq", "clip-iqa"])
def test_other_weights_are_refused(kind: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"not the weights of {kind}") as caught:
        scorers.convert(kind, checkpoint(nn.Linear(3, 4)), tmp_path / "scorer.onnx")
    assert "\n" not in str(caught.value)
