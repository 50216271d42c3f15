"""A ``run.toml`` of an earlier version can be read: settings that no longer exist are left out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from toy import Remarks

from cleargs.errors import ConfigError
from cleargs.pipeline.config import check_document, known_settings, load_config
from cleargs.pipeline.run_file import RUN_FILE, read_run_file
from cleargs.pipeline.session import resolve_run
from cleargs.pipeline.settings import settings_of
from cleargs.pipeline.stages import installed

OLD = (Path(__file__).with_name("old_run.toml")).read_text()
"""The recipe smoke as written by version 0.2.0: 190 settings, with those of a training in three tables."""


OTHER_DEFAULTS = [
    "ingest.camera_model=SIMPLE_RADIAL",
    "rivr.targets=auto",
    "g0.formation.pose=off",
    "g0.background=[0.0, 0.0, 0.0]",
    "g0.coarse_share=0.25",
]
"""Settings that the recipe had then and has no longer. A run keeps those of its file."""


def test_old_settings_are_the_recipe(tmp_path: Path) -> None:
    (tmp_path / RUN_FILE).write_text(f'input = "/capture"\n{OLD}')
    assert read_run_file(tmp_path, installed()).config == load_config(installed(), "smoke", OTHER_DEFAULTS)


def test_old_run_takes_new_settings(tmp_path: Path) -> None:
    """A setting that is gone does not contradict the new settings, and is named."""
    (tmp_path / "capture").mkdir()
    (tmp_path / RUN_FILE).write_text(OLD)
    overrides, remarks = ["g0.quality=high", "g0.lr_means=1e-4"], Remarks()
    run = resolve_run(installed(), tmp_path / "capture", tmp_path, overrides=overrides, reporter=remarks)
    assert run.config == load_config(installed(), "smoke", [*OTHER_DEFAULTS, *overrides])
    (line,) = remarks.warnings
    assert "rva.stand_in_share" in line and " more" in line


def test_names_that_no_version_has_are_left_out_of_run_files_alone() -> None:
    document = {"seed": 3, "g0": {"steps": 7, "stepz": 8, "formation": {"every": 5, "often": 6}}, "sofa": {}}
    known, others = known_settings(installed(), document)
    assert known == {"seed": 3, "g0": {"steps": 7, "formation": {"every": 5}}}
    assert sorted(others) == ["g0.formation.often", "g0.stepz", "sofa"]
    assert document["sofa"] == {}
    with pytest.raises(ConfigError, match=r"there is no setting"):
        check_document(installed(), document)


def test_later_trainings_follow_the_first() -> None:
    sections: Any = load_config(installed(), "default", ["g0.lr_sh=0.5", "g0.quality=draft"]).sections
    for stage in ("rivr", "consolidate"):
        training = sections[stage].distil.applied_to(sections["g0"], 100)
        assert (training.lr_sh, training.quality, training.densify) == (0.5, "draft", "off")


def test_settings_are_few() -> None:
    """A number that no user changes is a constant."""
    dag = installed()
    count = sum(len(settings_of(name, dag.load(name).CONFIG)) for name in dag.names)
    assert count <= 127
