"""Recipes, single settings, and errors that name the field, its range and the nearest right name."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest
from toy import Bench, toy_dag

from cleargs.errors import ConfigError, InputError, StoreError
from cleargs.pipeline.config import (
    check_document,
    load_config,
    merge,
    parse_override,
    read_recipe,
    read_toml,
    recipe_names,
)
from cleargs.pipeline.keys import key_config
from cleargs.pipeline.run_file import RunSpec, read_run_file, write_run_file
from cleargs.pipeline.runner import check_same_input
from cleargs.pipeline.session import opened_store, resolve_run
from cleargs.pipeline.settings import settings_of
from cleargs.pipeline.stages import Stages, installed, load_stage


@pytest.fixture
def dag(tmp_path: Path) -> Stages:
    return toy_dag(tmp_path / "journal")


@pytest.mark.parametrize(
    ("text", "document"),
    [
        ("a.b=0.7", {"a": {"b": 0.7}}),
        ("a=3", {"a": 3}),
        ("a.b=true", {"a": {"b": True}}),
        ("a.b=every:8", {"a": {"b": "every:8"}}),
        ("a.b=/tmp/model.onnx", {"a": {"b": "/tmp/model.onnx"}}),
        ('a.b="3"', {"a": {"b": "3"}}),
        ("a.b=[1, 2]", {"a": {"b": [1, 2]}}),
        ("a.b=x=y", {"a": {"b": "x=y"}}),
        ("a.b=", {"a": {"b": ""}}),
        ("a.b=1\nc = 2", {"a": {"b": "1\nc = 2"}}),
    ],
)
def test_override_values_are_toml_bare_words_strings(text: str, document: dict[str, object]) -> None:
    assert parse_override(text) == document


@pytest.mark.parametrize("text", ["a.b", "=3", "a..b=1"])
def test_malformed_override(text: str) -> None:
    with pytest.raises(ConfigError, match=r"does not have the form a\.b=value"):
        parse_override(text)


def test_merge_keeps_what_is_not_named() -> None:
    base = {"a": {"x": 1, "y": {"z": 2}}, "list": [1, 2]}
    assert merge(base, {"a": {"y": {"z": 3}}, "list": [4]}) == {"a": {"x": 1, "y": {"z": 3}}, "list": [4]}
    assert base["a"] == {"x": 1, "y": {"z": 2}}


@pytest.mark.parametrize(
    ("text", "cause", "hint"),
    [
        ("square.powr=3", "there is no setting square.powr", "did you mean square.power?"),
        ("sqare.power=3", "there is no setting sqare", "did you mean square?"),
        ("power=3", "there is no setting power", "did you mean square.power?"),
        ("total.power=3", "there is no setting total.power", "did you mean square.power?"),
        ("count.inner.dept=3", "there is no setting count.inner.dept", "did you mean count.inner.depth?"),
        (
            "square.power=9",
            "square.power = 9 cannot be used",
            "allowed: a whole number, at least 1 and at most 4",
        ),
        ("count.inner.depth=0", "count.inner.depth = 0 cannot be used", "at least 1 and at most 9"),
        ("total.offset=many", "total.offset = 'many' cannot be used", "a number, at least -1"),
        ("count.mode=pad", "count.mode = 'pad' cannot be used", "allowed: plain or padded"),
        (
            "count=3",
            "count = 3 cannot be used: count is a table of settings",
            "set one of them, for example count.limit",
        ),
        ("count.inner=3", "count.inner = 3 cannot be used", "set one of them, for example count.inner.depth"),
        ("seed=-1", "seed = -1 cannot be used", "a whole number from 0"),
        ("seed=true", "seed = True cannot be used", "a whole number from 0"),
    ],
)
def test_errors_teach(dag: Stages, text: str, cause: str, hint: str) -> None:
    with pytest.raises(ConfigError) as error:
        check_document(dag, parse_override(text))
    assert cause in str(error.value)
    assert hint in error.value.hint
    assert error.value.exit_code == 2


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("rivr.steps=30", "did you mean rivr.distil.steps?"),
        ("g0.expert=embedded", "did you mean rivr.expert?"),
        ("sed=3", "did you mean seed?"),
        ("g0.threads=3", "use the option --threads"),
    ],
)
def test_a_name_from_elsewhere_is_found(text: str, hint: str) -> None:
    with pytest.raises(ConfigError) as error:
        check_document(installed(), parse_override(text))
    assert error.value.hint == hint


def test_every_setting_has_a_meaning_and_a_range() -> None:
    for name in installed().names:
        for setting in settings_of(name, load_stage(name).CONFIG):
            assert setting.meaning and setting.allowed, setting.name


def test_run_file_has_the_meaning_of_each_setting(bench: Bench) -> None:
    document = check_document(installed(), {"ingest": {"holdout": "every:8"}})
    write_run_file(RunSpec(bench.folder, bench.capture, document, bench.store, "cpu"))
    text = (bench.folder / "run.toml").read_text()
    comment = (
        "# most frames to take, evenly; in a video, the sharpest nearby, and evenly by the motion of the "
        "picture if the\n# pace is uneven and fps is unset (a whole number, at least 3; default 240)"
    )
    assert f"{comment}\nmax_frames = 240\n" in text
    assert 'holdout = "every:8"' in text
    assert "default unset)\n# fps =\n" in text, "a setting without a value is there too"
    assert read_run_file(bench.folder, installed()).config == document


def test_recipe_file_then_overrides_then_seed(dag: Stages, tmp_path: Path) -> None:
    recipe = tmp_path / "mine.toml"
    recipe.write_text("seed = 3\n[square]\npower = 3\n[count]\nlimit = 7\n")
    config = load_config(dag, str(recipe), ["square.power=4"])
    assert config.seed == 3
    assert config.document()["square"]["power"] == 4
    assert config.document()["count"]["limit"] == 7
    assert load_config(dag, str(recipe), seed=9).seed == 9


def test_bad_recipes(dag: Stages, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no recipe 'defalt'") as error:
        read_recipe("defalt")
    assert error.value.hint == "did you mean default?"
    with pytest.raises(ConfigError, match="cannot read"):
        read_recipe(str(tmp_path / "none.toml"))
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("[square\npower = 3")
    with pytest.raises(ConfigError, match="not valid TOML"):
        read_recipe(str(wrong))
    wrong.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="cannot read"):
        read_recipe(str(wrong))


@pytest.mark.parametrize("recipe", ["default", "smoke", "paper", "paper-open"])
def test_installed_recipes_fit_the_installed_stages(recipe: str) -> None:
    assert recipe in recipe_names()
    load_config(installed(), recipe)


def test_default_recipe_says_what_the_models_say() -> None:
    assert load_config(installed(), "default") == check_document(installed(), {})


def test_run_file_gives_back_the_run(bench: Bench) -> None:
    run = bench.settings(["square.power=3", "count.mode=padded"], seed=5)
    write_run_file(run)
    assert read_run_file(bench.folder, bench.dag) == run
    elsewhere = bench.settings(store=bench.root / "shared")
    write_run_file(elsewhere)
    assert read_run_file(bench.folder, bench.dag) == elsewhere


def test_marked_settings_stay_out_of_the_key(dag: Stages) -> None:
    config = check_document(dag, {"count": {"weights": "/somewhere"}}).sections["count"]
    assert key_config(config) == {"limit": 100, "mode": "plain", "inner": {"depth": 3}}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('input = "x"\nstore = ["a"]\n', "damaged"),
        ('input = "a\\u0000b"\n', "damaged"),
        ('input = "x"\nstore = "a\\u0000b"\n', "damaged"),
        ("input = 7\n", "damaged"),
        ('input = "x"\na = ' + "[" * 5000, "nested too deeply"),
        ('input = "x"\nseed = ' + "9" * 5000 + "\n", "not valid TOML"),
    ],
)
def test_malformed_run_files(bench: Bench, text: str, words: str) -> None:
    bench.folder.mkdir()
    (bench.folder / "run.toml").write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        read_run_file(bench.folder, bench.dag)
    assert "\n" not in str(caught.value)


def test_a_damaged_device_hides_neither_input_nor_store(bench: Bench) -> None:
    """``--recipe`` replaces the settings only: the run keeps its capture and its store."""
    bench.folder.mkdir()
    shared, recipe = bench.root / "shared", bench.root / "empty.toml"
    recipe.touch()
    (bench.folder / "run.toml").write_text(f'input = "/elsewhere"\nstore = "{shared}"\ndevice = "tpu"\n')
    run = resolve_run(bench.dag, bench.capture, bench.folder, recipe=str(recipe), reporter=bench.remarks)
    assert run.store == shared
    with pytest.raises(InputError, match="is a run of /elsewhere"), opened_store(shared) as store:
        check_same_input(run, bench.dag, store)
    with pytest.raises(ConfigError, match="damaged"):
        resolve_run(bench.dag, bench.capture, bench.folder, reporter=bench.remarks)


def test_a_pipe_for_a_run_file(bench: Bench) -> None:
    bench.folder.mkdir()
    os.mkfifo(bench.folder / "run.toml")
    with pytest.raises(InputError, match="not a run"):
        read_run_file(bench.folder, bench.dag)
    with pytest.raises(ConfigError, match="not a regular file"):
        read_toml(bench.folder / "run.toml")


def test_small_disk_space_is_reported_in_megabytes(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil.disk_usage(bench.root)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=12_000))
    with pytest.raises(StoreError, match=r"needs about 3 MB of disk, and .* has 0 MB free"):
        bench.run()
