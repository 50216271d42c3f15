"""README's order, and the blocks of README and docs that are neither shell nor Python."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import get_args

import pytest

import cleargs
from cleargs import plugins
from cleargs.batch.sheet import SheetError, read_scenes
from cleargs.cli.main import COMMANDS
from cleargs.cli.user_config import user_defaults

ROOT = Path(__file__).parents[1]

READ = {
    ("docs/cite.md", "bibtex"): 1,
    ("docs/cluster.md", "toml"): 2,
    ("docs/cluster.md", ""): 1,
    ("docs/install.md", "toml"): 1,
    ("docs/plugins.md", "toml"): 1,
    ("docs/viewers.md", "html"): 1,  # by tests/report/test_drawn_by_engines.py
}
NOT_READ = {
    ("docs/cite.md", "bibtex"): 1,
    ("docs/capture.md", ""): "a drawing",
    ("docs/cluster.md", "yaml"): "for Snakemake on a cluster",
    ("docs/datasets.md", ""): "folders of data sets",
    ("docs/files.md", ""): "folders of a run",
    ("docs/inputs.md", ""): "folders of captures, and an output",
}
"""Page and language -> why nothing reads these blocks."""


def blocks(page: str, language: str) -> list[str]:
    text = (ROOT / page).read_text(encoding="utf-8")
    return [code for found, code in re.findall(r"(?ms)^ *```(\w*)\n(.*?)^ *```", text) if found == language]


def test_every_block_is_read_or_named() -> None:
    found: dict[tuple[str, str], int] = {}
    for path in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]:
        page = path.relative_to(ROOT).as_posix()
        for language in re.findall(r"(?ms)^ *```(\w*)\n.*?^ *```", path.read_text(encoding="utf-8")):
            if language not in ("sh", "python"):
                found[page, language] = found.get((page, language), 0) + 1
    assert found.keys() == READ.keys() | NOT_READ.keys()
    assert {key: number for key, number in found.items() if key in READ} == READ


def test_the_sheets_of_the_page_are_read(tmp_path: Path) -> None:
    scenes, after = blocks("docs/cluster.md", "toml")
    (tmp_path / "captures.toml").write_text(f"{after}\n{scenes}")
    (job,) = read_scenes(tmp_path / "captures.toml")
    assert job.name == "hall" and "rva.tau_R=0.6" in job.overrides and job.after.render == "turntable"
    (table,) = blocks("docs/cluster.md", "")
    (tmp_path / "captures.csv").write_text(table)
    assert [len(job.overrides) for job in read_scenes(tmp_path / "captures.csv")] == [1, 0]
    (tmp_path / "captures.toml").write_text(scenes.replace("input", "inputs"))
    with pytest.raises(SheetError):
        read_scenes(tmp_path / "captures.toml")


def test_the_users_configuration_of_the_page_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    (tmp_path / "cleargs").mkdir()
    (tmp_path / "cleargs/config.toml").write_text(*blocks("docs/install.md", "toml"))
    assert user_defaults(COMMANDS)["run"]["quality"] == "standard"


def test_the_entry_point_of_the_page_is_one_of_ours() -> None:
    groups = tomllib.loads(*blocks("docs/plugins.md", "toml"))["project"]["entry-points"]
    assert set(groups) <= {f"cleargs.{point}" for point in get_args(plugins.ExtensionPoint)}


def test_the_entry_to_cite_is_that_of_this_version() -> None:
    (entries,) = blocks("docs/cite.md", "bibtex")
    assert entries.count("{") == entries.count("}")
    paper, program = re.split(r"(?m)^(?=@)", entries)[1:]
    assert {"title", "author", "year", "note"} == set(re.findall(r"(?m)^  (\w+) +=", paper))
    assert f"version = {{{cleargs.__version__}}}" in program and "license" in program


def test_the_first_screen_of_the_readme_is_in_the_order_of_a_newcomer() -> None:
    """Once, the install block began inside a checkout that the reader did not have."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    parts = (
        "ClearGS turns a handheld video",
        "docs/guide/hero.jpg",
        "git clone ",
        "make demo ",
        "make test ",
        ".venv/bin/activate",
        "cleargs run walk.mp4",
        "| two CPU cores",
        "docs/guide/report.jpg",
        "Yes, where frames are blurred or skewed",
        "| real capture ",
        "**Limits.**",
        "NVIDIA GPU",
    )
    places = [text.index(part) for part in parts]
    assert places == sorted(places) and len(text.splitlines()) <= 60
