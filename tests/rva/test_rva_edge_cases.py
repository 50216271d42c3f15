"""Edge cases (no reliable frame, one frame; no motion, poses, points or scores), and sparse sums."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from rva_scenes import along_x, observations_of, poses_at, uniform_cues

from cleargs.rva.assessment import Observations, assess, frames_table, summary
from cleargs.rva.geometry import coverage_gain, cut_into_bins, redundancy, visibility
from cleargs.rva.tables import CUE_COLUMNS
from cleargs.stages.rva import RvaConfig

CONFIG = RvaConfig(active_share=0.0)


def ids(n: int) -> np.ndarray:
    return np.arange(n, dtype=np.int32)


def test_the_best_tenth_stands_in_when_no_frame_is_reliable() -> None:
    R = np.full(20, 0.4)
    R[[7, 3, 12]] = [0.6, 0.5, 0.5]  # two of twenty: frame 7, then the earlier of the tied 3 and 12
    result = assess(
        ids(20), uniform_cues(R, [0.2] * 20), poses_at(along_x(range(20))), observations_of({}), CONFIG
    )
    assert np.flatnonzero(result.fallback).tolist() == [3, 7]
    assert not result.reliable.any()
    assert "strong" not in result.role.tolist()
    assert result.D[19] == pytest.approx(0.65 * 16 / 19)  # farthest fallback: frame 3
    table = frames_table(ids(20), ["x"] * 20, "hand-1", uniform_cues(R, [0.2] * 20), result)
    chosen = [row["frame_id"] for row in table.to_pylist() if row["reliable"] or row["fallback"]]
    assert chosen == [3, 7]


@pytest.mark.parametrize(("R", "role", "weight"), [(0.9, "strong", 0.98), (0.1, "reactivated", 0.12)])
def test_one_frame(R: float, role: str, weight: float) -> None:
    result = assess(
        ids(1), uniform_cues([R], [0.1]), poses_at(along_x([3.0])), observations_of({0: [5]}), CONFIG
    )
    assert (result.D[0], result.O[0], result.bin[0], result.Z[0]) == (0.0, 0.0, 0, 1.0)
    assert result.role[0] == role
    assert result.weight[0] == pytest.approx(weight)


def test_a_camera_that_does_not_move_has_one_bin() -> None:
    points = observations_of({k: [1, 2] for k in range(30)})
    result = assess(
        ids(30), uniform_cues([0.8] * 30, [0.1] * 30), poses_at(along_x([2.0] * 30)), points, CONFIG
    )
    assert result.bin.tolist() == [0] * 30
    assert result.Z.tolist() == [1.0] * 30
    assert result.D.tolist() == [0.0] * 30
    assert result.O.tolist() == [1.0] * 30


def test_unregistered_frames_have_no_geometry_and_no_say() -> None:
    cues = uniform_cues([0.8, 1.0, 0.8], [0.1, 0.0, 0.1])
    points = observations_of({0: [1], 1: [1, 2, 3], 2: [2]})
    poses = poses_at(along_x([0.0, 99.0, 1.0]), registered=[True, False, True])
    result = assess(ids(3), cues, poses, points, CONFIG)
    assert np.isnan([result.C[1], result.D[1], result.O[1], result.G[1], result.Z[1]]).all()
    assert (result.bin[1], result.role[1], result.weight[1], result.reliable[1]) == (
        -1,
        "suppressed",
        0.0,
        False,
    )
    assert result.D[0] == 0.65  # the largest distance is 1: frame 1's place does not count
    row = frames_table(ids(3), ["a", "b", "c"], "hand-1", cues, result).to_pylist()[1]
    assert [row[name] for name in ("C", "D", "O", "G", "bin", "Z")] == [None] * 6


def test_a_blurred_camera_that_does_not_move_keeps_one_frame() -> None:
    cues = uniform_cues([0.1, 0.1, 0.2, 0.2], [0.9] * 4)
    result = assess(ids(4), cues, poses_at(along_x([2.0] * 4)), observations_of({}), CONFIG)
    # There is one bin, with G = 0 and Z = 1 for all frames. R decides; frames 2 and 3 tie, the earlier wins.
    assert result.role.tolist() == ["suppressed", "suppressed", "reactivated", "suppressed"]
    assert result.weight.tolist() == [0.0, 0.0, 0.12, 0.0]


def test_unscored_frames_have_no_geometry_and_no_say() -> None:
    cues = uniform_cues([0.8, 0.9, 0.8], [0.1, 0.1, 0.1])
    cues[1] = np.nan
    points = observations_of({0: [1, 2], 1: [2, 3], 2: [3, 4]})
    result = assess(ids(3), cues, poses_at(along_x([0.0, 99.0, 1.0])), points, CONFIG)
    assert np.isnan([getattr(result, name)[1] for name in ("R", "B", "C", "D", "O", "G", "Z")]).all()
    assert (result.bin[1], result.role[1], result.weight[1]) == (-1, "suppressed", 0.0)
    assert not result.reliable[1]
    assert result.D[0] == 0.65  # the largest distance is 1: frame 1's place does not count
    assert result.O.tolist()[::2] == [0.0, 0.0]  # nor do its points, which both others share
    row = frames_table(ids(3), ["a", "b", "c"], "hand-1", cues, result).to_pylist()[1]
    assert [row[name] for name in (*CUE_COLUMNS, "R", "B", "C", "D", "O", "G", "bin", "Z")] == [None] * 19


def test_an_unscored_frame_is_not_reactivated() -> None:
    """Its gain is NaN, which must not win the bin."""
    cues = uniform_cues([0.1, 0.1, 0.1], [0.9, 0.9, 0.9])
    cues[0] = np.nan
    result = assess(ids(3), cues, poses_at(along_x([0.0, 1.0, 2.0])), observations_of({}), CONFIG)
    assert result.role.tolist()[0] == "suppressed"
    assert sorted(result.role.tolist()[1:]) == ["reactivated", "suppressed"]


def test_no_frame_is_scored() -> None:
    cues = np.full((2, 11), np.nan)
    result = assess(ids(2), cues, poses_at(along_x([0.0, 1.0])), observations_of({0: [1], 1: [1]}), CONFIG)
    assert result.weight.tolist() == [0.0, 0.0]
    assert not result.fallback.any()


def test_no_frames() -> None:
    result = assess(ids(0), uniform_cues([], []), poses_at(along_x([])), observations_of({}), CONFIG)
    assert len(result.weight) == 0
    assert frames_table(ids(0), [], "hand-1", uniform_cues([], []), result).num_rows == 0
    assert summary(result, "hand-1")["effective_frames"] == 0.0


def test_no_frame_is_registered() -> None:
    poses = poses_at(along_x([0.0, 1.0]), registered=[False, False])
    result = assess(ids(2), uniform_cues([0.9, 0.9], [0.1, 0.1]), poses, observations_of({}), CONFIG)
    assert result.role.tolist() == ["suppressed", "suppressed"]
    assert not result.fallback.any()


def test_a_frame_without_points_has_neither_gain_nor_overlap() -> None:
    points = observations_of({0: [1, 2], 2: [2, 3]})
    result = assess(
        ids(3), uniform_cues([0.8, 0.2, 0.2], [0.1] * 3), poses_at(along_x([0.0, 1.0, 2.0])), points, CONFIG
    )
    assert (result.C[1], result.O[1]) == (0.0, 0.0)
    assert result.O[2] == pytest.approx(1 / 3)


def test_points_of_frames_outside_the_table_count_nowhere() -> None:
    cues, poses = uniform_cues([0.8, 0.2], [0.1, 0.1]), poses_at(along_x([0.0, 1.0]))
    alone = assess(ids(2), cues, poses, observations_of({0: [1], 1: [1, 2]}), CONFIG)
    with_other = assess(ids(2), cues, poses, observations_of({0: [1], 1: [1, 2], 7: [1, 2, 3]}), CONFIG)
    assert with_other.C.tolist() == alone.C.tolist()
    # n_1 = 2, n_2 = 1: C_1 = 1 / (1 + 1/sqrt 2)
    assert alone.C[1] == pytest.approx(1 / (1 + 2**-0.5))


def test_the_last_frame_belongs_to_the_last_bin() -> None:
    bins = cut_into_bins(np.linspace(0.0, 0.7, 17), frames_per_bin=4)
    assert bins.index.max() == 3
    assert bins.index[-1] == 3


def test_sparse_sums_equal_sets() -> None:
    rng = np.random.default_rng(5)
    sets = [set(rng.choice(60, size=rng.integers(0, 30), replace=False).tolist()) for _ in range(25)]
    reference = rng.random(25) < 0.4
    pairs = [(frame, point) for frame, seen in enumerate(sets) for point in seen]
    pairs += pairs[:10]  # a repeated pair counts once
    rows, points = np.array(pairs).T
    seen = visibility(ids(25), rows, points)
    observers = {point: sum(point in one for one in sets) for point in range(60)}
    covered = set().union(*(sets[j] for j in np.flatnonzero(reference)))
    for i, own in enumerate(sets):
        total = sum(observers[p] ** -0.5 for p in own)
        gained = sum(observers[p] ** -0.5 for p in own - covered)
        overlaps = [
            len(own & sets[j]) / len(own | sets[j])
            for j in np.flatnonzero(reference)
            if j != i and own | sets[j]
        ]
        assert coverage_gain(seen, reference)[i] == pytest.approx(gained / total if own else 0.0)
        assert redundancy(seen, reference)[i] == pytest.approx(max(overlaps, default=0.0))


def test_a_long_capture_needs_no_square_array() -> None:
    """Peak memory is far below that of one array of T x T or T x P entries.

    There are 5,000 frames of 40 points. Each shares half of its points with the next frame, which makes
    100,000 points and 200,000 observations. One T x T array of float64 has 200 MB, one T x P array of bytes
    500 MB. Blocks of 2^20 pairs take 8 MB per array, and a few of them are in memory at a time.
    """
    count, points = 5_000, 40
    frame = np.repeat(ids(count), points)
    seen = np.arange(points)[None, :] + (points // 2) * np.arange(count)[:, None]
    good = np.arange(count) % 3 > 0  # most frames are reliable, so that most pairs are visited
    cues = uniform_cues(np.where(good, 0.9, 0.3), np.where(good, 0.1, 0.7))
    poses = poses_at(along_x(np.linspace(0.0, 1.0, count)))
    observations = Observations(frame, seen.ravel())
    tracemalloc.start()
    try:
        result = assess(ids(count), cues, poses, observations, CONFIG)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 100e6
    # Frame 0 (not reliable) shares 20 points with frame 1 (reliable): 20 / (40 + 40 - 20).
    assert result.O[0] == pytest.approx(1 / 3)
    assert result.C[0] > 0.0
