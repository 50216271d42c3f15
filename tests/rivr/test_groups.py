"""Along the trajectory: groups of targets whose repairs are distilled before the next group is rendered."""

from __future__ import annotations

import pkgutil
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from test_stages import TARGETS, KilledError, capture, digests, dying, expert, make_capture
from tiny_capture import ROLES, Capture, Sharpen, tiny_consolidate, tiny_g0, tiny_rivr, tried_rows

from cleargs.media.exr import read_exr
from cleargs.rivr.targets import trajectory_groups
from cleargs.stages import consolidate, rivr

__all__ = ["capture", "expert"]  # fixtures

STEPS = 12


@pytest.mark.parametrize(
    ("frames", "size", "sizes"),
    [
        (7, None, [7]),
        (7, 7, [7]),
        (7, 100, [7]),
        (7, 3, [2, 2, 3]),  # three groups are needed for groups of at most three
        (8, 4, [4, 4]),
        (9, 4, [3, 3, 3]),
        (3, 1, [1, 1, 1]),
        (0, 4, [0]),
    ],
)
def test_groups_follow_the_trajectory(frames: int, size: int | None, sizes: list[int]) -> None:
    targets: Any = list(range(frames))
    groups = trajectory_groups(targets, size, STEPS)
    assert [len(group.targets) for group in groups] == sizes
    assert [frame for group in groups for frame in group.targets] == targets


@pytest.mark.parametrize("steps", [1, 5, 12, 600, 3000])
@pytest.mark.parametrize("size", [None, 1, 2, 3, 8, 50])
def test_a_round_has_the_same_steps_whatever_the_group_size(size: int | None, steps: int) -> None:
    targets: Any = list(range(23))
    groups = trajectory_groups(targets, size, steps)
    assert sum(group.steps for group in groups) == steps
    for group in groups:
        assert abs(group.steps - steps * len(group.targets) / 23) < 1.0
    assert groups[-1].steps >= 1  # so that no step is left over where the first groups have nothing to distil


def logged(context: Any) -> dict[str, list[Any]]:
    table: dict[str, list[Any]] = pq.read_table(context.out / "train.parquet").to_pydict()
    return table


@pytest.mark.parametrize("group", [1, 3, 5, None])
def test_all_group_sizes_train_equally_long(capture: Capture, group: int | None) -> None:
    context = capture.context("rivr", tiny_rivr(group=group))
    rivr.run(context)
    rows = tried_rows(context)
    assert [(row.round, row.frame_id) for row in rows] == [(n, k) for n in (1, 2) for k in TARGETS]
    assert [logged(context)["round"].count(number) for number in (1, 2)] == [STEPS, STEPS]


def test_one_group_of_all_is_the_round_at_once(capture: Capture) -> None:
    found = []
    for group in (None, len(TARGETS)):
        context = capture.context("rivr", tiny_rivr(group=group), run=f"group_{group}")
        rivr.run(context)
        found.append(digests(context.out))
    assert found[0] == found[1]


def test_a_group_sees_what_was_distilled_from_those_before_it(capture: Capture) -> None:
    whole = capture.context("rivr", tiny_rivr(rounds=1), run="whole")
    parts = capture.context("rivr", tiny_rivr(rounds=1, group=3), run="parts")
    rivr.run(whole)
    rivr.run(parts)

    def rendered(context: Any, frame_id: int) -> np.ndarray:
        return read_exr(context.out / f"round_01/{frame_id:06d}.exr").layers["render"]

    sizes = [len(group.targets) for group in trajectory_groups([None] * len(TARGETS), 3, STEPS)]  # type: ignore[list-item]
    for place, frame_id in enumerate(TARGETS):
        same = np.array_equal(rendered(whole, frame_id), rendered(parts, frame_id))
        assert same == (place < sizes[0])  # the first group alone is rendered from G0
    # Until the last group is done, nothing of its frames has been distilled.
    drawn = logged(parts)
    early = drawn["frame_id"][: STEPS * sizes[0] // len(TARGETS)]
    repaired = {k for k, kind in zip(early, drawn["kind"], strict=False) if kind == "pseudo"}
    assert repaired <= set(TARGETS[: sizes[0]])


def test_steps_of_groups_without_a_repair_go_to_the_next(capture: Capture) -> None:
    """With fewer steps than groups some have none; they are spent where the next group has some."""
    context = capture.context("rivr", tiny_rivr(group=1, rounds=1, distil={"steps": 3}))
    rivr.run(context)
    assert len(logged(context)["step"]) == 3


def test_every_frame_is_a_target_and_nothing_is_judged(capture: Capture) -> None:
    """The paper's way: no frame is held out, no veto even of a wrecked scene."""
    wrecking = tiny_g0(lr_scales=3.0)
    config = tiny_rivr(rounds=1, group=4, harm={"control": 0.0, "psnr_margin": 0.0, "score_margin": 0.0})
    context = capture.context("rivr", config, g0=wrecking)
    result = rivr.run(context)
    rows = tried_rows(context)
    assert [row.frame_id for row in rows] == list(range(len(ROLES)))
    assert result.summary["control"]["frames"] == []
    assert result.summary["control"]["psnr_after"] is None
    assert result.summary["published"] == "distilled scene"
    assert not (context.out / "rejected.ply").exists()
    after = capture.context("consolidate", tiny_consolidate(), g0=wrecking, rivr=config)
    assert consolidate.run(after).summary["published"] == "consolidated scene"
    assert pq.read_table(after.out / "repairs.parquet").num_rows == len(ROLES)


def test_even_draws_raw_and_repaired_views_alike(capture: Capture) -> None:
    distil = {"steps": 130, "pseudo_share": "even"}
    context = capture.context("rivr", tiny_rivr(rounds=1, distil=distil))
    rivr.run(context)
    kinds = logged(context)["kind"]
    # 7 repairs and the 6 active frame images: ten epochs of the union
    assert (kinds.count("pseudo"), kinds.count("real")) == (70, 60)


def run_both(capture: Capture) -> dict[str, dict[str, str]]:
    """Both stages, three groups per round; the digests of their files."""
    first = capture.context("rivr", tiny_rivr(group=3))
    rivr.run(first)
    second = capture.context("consolidate", tiny_consolidate())
    consolidate.run(second)
    return {"rivr": digests(first.out), "consolidate": digests(second.out)}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, str]]:
    with pytest.MonkeyPatch.context() as patch:
        return run_both(make_capture(tmp_path_factory.mktemp("undisturbed"), Sharpen(), patch))


# Three groups per round: frames 0 1 | 2 4 | 5 6 7, of 3, 3 and 6 steps.
@pytest.mark.parametrize(
    ("where", "after"),
    [
        ("cleargs.rivr.rounds.write_exr", 1),  # inside the first group
        ("cleargs.rivr.rounds.write_exr", 3),  # inside the second
        ("cleargs.rivr.rounds.write_exr", 4),  # at the start of the third
        ("cleargs.splat.trainer.Trainer.step", 4),  # inside the second group's distillation
        ("cleargs.splat.trainer.Trainer.step", 11),  # inside the third's, after its checkpoint
        ("cleargs.splat.ply.write_ply", 1),  # at the end of the second's, before its last file
        ("cleargs.scene.folder.SceneFolder.drop_state", 3),  # between two groups of round 2
        ("cleargs.scene.folder._copy", 1),  # while publishing
    ],
)
def test_a_run_killed_among_its_groups_goes_on_to_the_same_files(
    capture: Capture,
    undisturbed: dict[str, dict[str, str]],
    monkeypatch: pytest.MonkeyPatch,
    where: str,
    after: int,
) -> None:
    with monkeypatch.context() as patch:
        module, _, name = where.rpartition(".")
        patch.setattr(where, dying(after, getattr(pkgutil.resolve_name(module), name)))
        with pytest.raises(KilledError):
            run_both(capture)
    assert run_both(capture) == undisturbed
