"""Whole batches on this machine, with Snakemake as the engine and toy stages."""

from __future__ import annotations

import os
import signal

import pytest
from toy_batch import SCENES, ToyBatch, finish

from cleargs.pipeline.lock import file_lock

pytestmark = pytest.mark.usefixtures("engine")


def test_a_bad_scene_stops_no_other_and_a_second_batch_does_only_what_is_missing(toy: ToyBatch) -> None:
    (toy.capture("barn") / "11.txt").write_text("no number")  # square cannot take it
    code, scenes = toy.run()
    assert code == 1
    assert {name: state["state"] for name, state in scenes.items()} == {
        "attic": "done",
        "barn": "failed",
        "cellar": "done",
    }
    bad = scenes["barn"]
    assert (bad["stage"], bad["finished"]) == ("square", 1)
    assert "no number" in bad["cause"] and "no number" in toy.folder.log("barn", "square").read_text()
    assert bad["log"] == str(toy.folder.log("barn", "square"))
    assert toy.digests("attic") == toy.undisturbed("attic")
    toy.work_done()

    (toy.capture("barn") / "11.txt").write_text("11")
    code, scenes = toy.run()
    assert code == 0, toy.engine_said()
    assert {state["state"] for state in scenes.values()} == {"done"}
    assert sorted({line for line in toy.work_done() if line in toy.dag.names}) == ["count", "square", "total"]
    assert toy.digests("barn") == toy.undisturbed("barn")

    toy.work_done()
    assert toy.run()[0] == 0
    assert toy.work_done() == []
    assert "Nothing to be done" in toy.engine_said()


def test_a_changed_setting_touches_its_scene_and_the_stages_behind_it_only(toy: ToyBatch) -> None:
    assert toy.run()[0] == 0
    toy.work_done()
    toy.write_sheet(scenes={"attic": "", "barn": "[scene.set]\nsquare.power = 3", "cellar": ""})
    assert toy.run()[0] == 0
    stages = [line for line in toy.work_done() if line in toy.dag.names]
    assert stages == ["square", "total"]
    toy.write_sheet()  # going back is a hit
    assert toy.run()[0] == 0
    assert toy.work_done() == []
    assert toy.digests("barn") == toy.undisturbed("barn")


def test_a_stage_done_in_part_is_said_so_and_tried_again(toy: ToyBatch) -> None:
    (toy.capture("cellar") / "20.txt").write_text("")
    code, scenes = toy.run()
    assert code == 3
    assert scenes["cellar"]["state"] == "partial" and "20.txt is empty" in scenes["cellar"]["cause"]
    assert scenes["attic"]["state"] == scenes["barn"]["state"] == "done"


def test_a_second_batch_is_refused_and_one_whose_engine_was_killed_goes_on(toy: ToyBatch) -> None:
    toy.write_sheet("[set]\nsquare.delay_s = 1")
    first = toy.start(start_new_session=True)
    toy.wait_for("square 1.txt")
    states = toy.states()
    assert states["attic"].state == "running" and states["attic"].finished == 1
    second = toy.start()
    _, errors = second.communicate(timeout=60)
    assert second.returncode == 1 and "at work already" in errors

    os.killpg(first.pid, signal.SIGKILL)
    first.communicate()
    os.killpg(toy.engine, signal.SIGKILL)  # with all that it had started
    code, scenes = finish(toy.start())
    assert code == 0, toy.engine_said()
    assert {state["state"] for state in scenes.values()} == {"done"}
    work = toy.work_done()
    assert work.count("square 0.txt") == 1, f"the checkpoint was not used: {work}"
    assert all(toy.digests(scene) == toy.undisturbed(scene) for scene in SCENES)


def test_an_interrupted_batch_ends_its_jobs_and_goes_on_later(toy: ToyBatch) -> None:
    toy.write_sheet("[set]\nsquare.delay_s = 0.5", scenes={"attic": ""})
    batch = toy.start()
    toy.wait_for("square 1.txt")
    batch.send_signal(signal.SIGINT)
    batch.communicate(timeout=60)
    assert batch.returncode != 0
    with file_lock(toy.folder.root / "batch.lock"):  # the engine, which takes its leave by itself, has it
        assert toy.states()["attic"].stage == "square"
    code, _ = toy.run()
    assert code == 0, toy.engine_said()
    assert toy.work_done().count("square 0.txt") == 1
