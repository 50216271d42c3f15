"""``cleargs show RUN rva --plot``: the plot of a run, and wrong usage."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import pytest
from vlm_server import two_stages

from cleargs.cli.main import invoke


class Shell:
    """A run of six flat frames, and ``show`` on it."""

    def __init__(self, root: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.folder = root / "walk"
        self.capsys = capsys
        self.root = root
        (root / "empty.toml").touch()
        (root / "source").mkdir()
        assert self(
            "run", str(root / "source"), "-o", str(self.folder), "--workflow", str(root / "empty.toml")
        )

    def __call__(self, *arguments: str) -> tuple[int, str, str]:
        code = invoke(list(arguments), two_stages())
        streams = self.capsys.readouterr()
        return code, streams.out, streams.err

    def plot(self, *options: str, stage: str = "rva") -> tuple[int, str, str]:
        return self("show", str(self.folder), stage, *options)

    def files(self) -> dict[str, bytes]:
        return {str(file): file.read_bytes() for file in self.folder.rglob("*") if file.is_file()}


@pytest.fixture
def shell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Shell:
    monkeypatch.delenv("CLEARGS_STORE", raising=False)
    return Shell(tmp_path, capsys)


def test_the_plot_is_the_only_new_file_in_the_run(shell: Shell) -> None:
    before = shell.files()
    code, out, err = shell.plot("--plot")
    picture = shell.folder / "rva-plot.png"
    assert (code, out, err) == (0, f"written: {picture}\n", "")
    assert cv2.imread(str(picture)) is not None
    after = shell.files()
    assert set(after) - set(before) == {str(picture)}
    assert {name: after[name] for name in before} == before


def test_the_plot_can_go_elsewhere(shell: Shell) -> None:
    elsewhere = shell.root / "new" / "a.png"
    code, out, _ = shell.plot("--plot", "-o", str(elsewhere), "--json")
    assert code == 0 and json.loads(out) == {"stage": "rva", "plot": str(elsewhere)}
    assert elsewhere.is_file() and not (shell.folder / "rva-plot.png").exists()


@pytest.mark.parametrize(
    ("stage", "options", "words"),
    [
        ("ingest", ["--plot"], "--plot needs the stage rva"),
        ("rva", ["-o", "a.png"], "--output needs --plot or --frame, and a .png file"),
        ("rva", ["--plot", "-o", "a.jpg"], "--output needs --plot or --frame, and a .png file"),
    ],
)
def test_wrong_usage(shell: Shell, stage: str, options: list[str], words: str) -> None:
    code, out, err = shell.plot(*options, stage=stage)
    assert (code, out) == (2, "")
    assert err.splitlines()[0] == f"error: {words}" and err.splitlines()[1].startswith("hint: cleargs show ")
