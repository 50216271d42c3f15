"""The form of the scripts in findings/. `make findings` runs them, as they need the network."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "findings"
SCRIPTS = sorted(FOLDER.glob("*.sh"))


def test_the_table_lists_every_script_once() -> None:
    listed = re.findall(r"^\| \[([\w-]+)\]\(\1\.sh\) \|", (FOLDER / "README.md").read_text(), re.MULTILINE)
    assert sorted(listed) == [script.stem for script in SCRIPTS]
    assert len(SCRIPTS) >= 10


def test_tests_and_sources_that_the_table_names_exist() -> None:
    named = re.findall(r"`((?:tests|cleargs)/[\w/]+\.py)`", (FOLDER / "README.md").read_text())
    assert named
    assert [name for name in named if not (FOLDER.parent / name).is_file()] == []


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_a_script_stands_alone_and_leaves_nothing(script: Path) -> None:
    text = script.read_text()
    assert script.stat().st_mode & 0o111
    for part in (
        "set -euo pipefail\nwork=$(mktemp -d)\ntrap 'rm -rf \"$work\"' EXIT\n",
        "# Guess: ",
        "# Seen: ",
    ):
        assert part in text
    assert "exit 2" in text and ("CHANGED" in text)
    assert "cleargs" not in text.lower() and "index-url" not in text and "://" not in text
    installed = re.findall(r"(?:pip install|npm install)(.*?)\|\|", text.replace("\\\n", " "), re.DOTALL)
    packages = [word for part in installed for word in part.split() if not word.startswith("-")]
    assert packages and all(re.fullmatch(r"[\w.@/-]+(==|@)[\d.]+", package) for package in packages)
