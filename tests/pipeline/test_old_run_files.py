"""A ``run.toml`` of an earlier version can be read, including its retired settings."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest

from cleargs.errors import ConfigError
from cleargs.pipeline.config import check_document, load_config, merge, parse_override
from cleargs.pipeline.dag import installed
from cleargs.pipeline.run_file import RUN_FILE
from cleargs.pipeline.session import resolve_run
from cleargs.pipeline.settings import settings_of

OLD = (Path(__file__).with_name("old_run.toml")).read_text()
"""The recipe smoke as written by version 0.2.0: 190 settings, with those of a training in three tables."""


OTHER_DEFAULTS = [
    "ingest.camera_model=SIMPLE_RADIAL",
    "rivr.targets=auto",
    "g0.formation.pose=off",
    "g0.formation.unexplained=0.0",
    "g0.background=[0.0, 0.0, 0.0]",
]
"""Settings that the recipe had then and has no longer. A run keeps those of its file."""


def old(*changes: str) -> dict[str, Any]:
    document = tomllib.loads(OLD)
    for change in changes:
        document = merge(document, parse_override(change))
    return document


def test_old_settings_are_the_recipe() -> None:
    assert check_document(installed(), old()) == load_config(installed(), "smoke", OTHER_DEFAULTS)


def test_old_run_takes_new_settings(tmp_path: Path) -> None:
    """Its retired settings do not contradict the new ones."""
    (tmp_path / "capture").mkdir()
    (tmp_path / RUN_FILE).write_text(OLD)
    overrides = ["g0.quality=high", "g0.lr_means=1e-4"]
    run = resolve_run(installed(), tmp_path / "capture", tmp_path, overrides=overrides, say=lambda line: None)
    assert run.config == load_config(installed(), "smoke", [*OTHER_DEFAULTS, *overrides])


@pytest.mark.parametrize(
    ("change", "name", "remedy"),
    [
        ("rivr.distil.lr_means=0.1", "rivr.distil.lr_means", "set g0.lr_means"),
        ("consolidate.distil.formation.enabled=false", "consolidate.distil.formation", "set g0.formation"),
        ("consolidate.harm.psnr_margin=3.0", "consolidate.harm", "set rivr.harm"),
        ("g0.growth=0.5", "g0.growth", "take the line out"),
        ("g0.strategy=adaptive", "g0.strategy", "take the line out"),
        ("rivr.distil.opacity_reg=0.1", "rivr.distil.opacity_reg", "take the line out"),
    ],
)
def test_contradicting_name_is_an_error(change: str, name: str, remedy: str) -> None:
    with pytest.raises(ConfigError, match=f"^{name} = .* is no longer a setting") as caught:
        check_document(installed(), old(change))
    assert remedy in caught.value.hint


@pytest.mark.parametrize("change", ["rivr.distil.noise=0.0", "rivr.distil.adaptive.grad=1.0"])
def test_name_without_effect_is_dropped(change: str) -> None:
    assert check_document(installed(), old(change)) == check_document(installed(), old())


def test_later_trainings_follow_the_first() -> None:
    sections: Any = load_config(installed(), "default", ["g0.lr_sh=0.5", "g0.quality=draft"]).sections
    for stage in ("rivr", "consolidate"):
        training = sections[stage].distil.applied_to(sections["g0"], 100)
        assert (training.lr_sh, training.quality, training.densify) == (0.5, "draft", False)


def test_settings_are_few() -> None:
    """A number that no user changes is a constant."""
    dag = installed()
    count = sum(len(settings_of(name, dag.load(name).CONFIG)) for name in dag.names)
    assert count <= 127
