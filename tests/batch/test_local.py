"""Whole batches on this machine, with Snakemake as the engine and toy stages."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest
from toy_batch import ToyBatch, make_toy_batch

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("engine")]


def kinds(scenes: dict[str, dict[str, Any]]) -> dict[str, str]:
    """Scene -> what became of it."""
    return {name: state["state"] for name, state in scenes.items()}


def test_a_bad_scene_stops_no_other_and_a_second_batch_does_only_what_is_missing(toy: ToyBatch) -> None:
    (toy.capture("barn") / "11.txt").write_text("no number")  # square cannot take it
    (toy.capture("cellar") / "20.txt").write_text("")  # count leaves it out
    code, scenes = toy.run()
    assert code == 1
    assert kinds(scenes) == {"attic": "done", "barn": "failed", "cellar": "partial"}
    bad = scenes["barn"]
    assert (bad["stage"], bad["finished"]) == ("square", 1)
    assert "no number" in bad["cause"] and "no number" in toy.folder.log("barn", "square").read_text()
    assert bad["log"] == str(toy.folder.log("barn", "square"))
    assert "20.txt is empty" in scenes["cellar"]["cause"]
    assert toy.digests("attic") == toy.undisturbed("attic")
    toy.work_done()

    (toy.capture("barn") / "11.txt").write_text("11")
    code, scenes = toy.run()
    assert code == 3, toy.engine_said()
    assert kinds(scenes) == {"attic": "done", "barn": "done", "cellar": "partial"}
    stages = [line for line in toy.work_done() if line in toy.dag.names]
    assert sorted(stages) == ["count", "count", "square", "total"], "barn, and cellar's count once more"
    assert toy.digests("barn") == toy.undisturbed("barn")


def test_a_changed_setting_touches_its_scene_and_the_stages_behind_it_only(toy: ToyBatch) -> None:
    toy.write_sheet(scenes={"attic": "", "barn": ""})
    assert toy.run()[0] == 0
    toy.work_done()
    toy.write_sheet(scenes={"attic": "", "barn": "[scene.set]\nsquare.power = 3"})
    assert toy.run()[0] == 0
    stages = [line for line in toy.work_done() if line in toy.dag.names]
    assert stages == ["square", "total"]
    toy.write_sheet(scenes={"attic": "", "barn": ""})  # going back is a hit
    assert toy.run()[0] == 0
    assert toy.work_done() == []
    assert "Nothing to be done" in toy.engine_said()
    assert toy.digests("barn") == toy.undisturbed("barn")


def test_a_second_batch_is_refused_and_one_whose_engine_was_killed_goes_on(toy: ToyBatch) -> None:
    two = {"attic": "", "barn": ""}
    toy.write_sheet(toy.held(), scenes=two)
    first = toy.start(start_new_session=True)
    toy.wait_for("held")
    working = {state.scene for state in toy.states().values() if state.state == "running"}
    assert working and {toy.states()[scene].finished for scene in working} == {1}
    second = toy.start()
    _, errors = second.communicate(timeout=60)
    assert second.returncode == 1 and "at work already" in errors

    os.killpg(first.pid, signal.SIGKILL)
    first.communicate()
    os.killpg(toy.engine, signal.SIGKILL)  # with all that it had started
    toy.hold.unlink()
    code, scenes = toy.run()
    assert code == 0, toy.engine_said()
    assert kinds(scenes) == {"attic": "done", "barn": "done"}
    squares = toy.squares()
    assert len(squares) == len(set(squares)) == 12, f"no checkpoint was used: {squares}"
    assert all(toy.digests(scene) == toy.undisturbed(scene) for scene in two)


def test_an_interrupted_batch_ends_its_jobs_and_goes_on_later(toy: ToyBatch) -> None:
    toy.write_sheet(toy.held(), scenes={"attic": ""})
    batch = toy.start()
    toy.wait_for("held")
    batch.send_signal(signal.SIGINT)
    batch.communicate(timeout=60)
    assert batch.returncode == 130
    toy.hold.unlink()
    code, _ = toy.run()  # which waits for the end of the first engine
    assert code == 0, toy.engine_said()
    assert toy.squares().count("square 0.txt") == 1


def test_jobs_of_an_earlier_batch_find_their_rule_in_the_plan_of_a_later_one(toy: ToyBatch) -> None:
    """Where the login node died they are left on the cluster, and read the plan when they start."""
    toy.write_sheet(scenes={"attic": ""})
    code, scenes = toy.run("local", "--until", "square")
    assert (code, kinds(scenes), scenes["attic"]["finished"]) == (0, {"attic": "done"}, 2)
    assert not toy.finished("attic", "total")
    plan = toy.folder.read_plan()
    assert plan is not None and "total" in plan.stages and "total" in plan.scenes["attic"]

    toy.write_sheet(scenes={"barn": ""})
    said, errors = toy.start("local", "--dry-run").communicate(timeout=60)
    assert json.loads(said) == {"scenes": 1, "jobs": {"count": 1, "square": 1, "total": 1}}, errors
    assert toy.folder.read_plan() == plan


def test_odd_names_and_folders(tmp_path: Path) -> None:
    """Shell, Snakemake and the formats of both have signs of their own."""
    root = tmp_path / 'it\'s {odd} $HOME; & "so" %j'
    root.mkdir()
    odd = make_toy_batch(root)
    odd.capture("attic").rename(root / "a capture, {scene}*")
    block = '[[scene]]\nname = "a.b-c_D..E"\ninput = "a capture, {scene}*"\n'
    odd.sheet.write_text(f'recipe = "empty.toml"\n{block}')
    code, scenes = odd.run()
    assert code == 0, odd.engine_said()
    assert kinds(scenes) == {"a.b-c_D..E": "done"}
