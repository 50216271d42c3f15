"""Properties of every capture, tested with hypothesis."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from random import Random

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from rva_scenes import poses_at
from scipy.spatial.transform import Rotation

from cleargs.rva.allocation import Role
from cleargs.rva.assessment import Assessment, Observations, Poses, assess
from cleargs.stages.rva import RvaConfig

PER_FRAME = [field.name for field in fields(Assessment) if field.name not in ("covered", "bin_edges")]


@dataclass(frozen=True)
class Capture:
    frame_id: np.ndarray
    cues: np.ndarray
    poses: Poses
    observations: Observations
    config: RvaConfig

    def assess(self) -> Assessment:
        return assess(self.frame_id, self.cues, self.poses, self.observations, self.config)


@st.composite
def captures(draw: st.DrawFn) -> Capture:
    """Up to 24 frames, some without a pose or scores. Quality has steps, so that all roles and ties occur."""
    n = draw(st.integers(1, 24))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    level = draw(st.sampled_from([0.2, 0.5, 0.8, 1.0]))  # the best quality of the capture
    cues = np.round(rng.uniform(0.0, 1.0, (n, 11)) ** 0.5 * 4) / 4
    cues[:, :5] *= level
    cues[rng.random(n) >= draw(st.sampled_from([0.8, 1.0]))] = np.nan
    rotations = Rotation.random(n, random_state=int(rng.integers(2**31))).as_matrix()
    centres = np.cumsum(rng.normal(size=(n, 3)), axis=0) * draw(st.sampled_from([0.0, 1e-3, 1.0]))
    if draw(st.booleans()):
        rotations = np.tile(rotations[:1], (n, 1, 1))
    frame_id = np.sort(rng.choice(1000, size=n, replace=False)).astype(np.int32)
    row, point = rng.integers(0, [n, 40], size=(draw(st.integers(0, 150)), 2)).T
    return Capture(
        frame_id=frame_id,
        cues=cues,
        poses=poses_at(centres, rotations, rng.random(n) < draw(st.sampled_from([0.7, 1.0]))),
        observations=Observations(frame_id[row], point),
        config=RvaConfig(frames_per_bin=draw(st.integers(1, 8)), active_share=0.0),
    )


@given(captures())
def test_scores_and_weights_lie_in_the_unit_interval(capture: Capture) -> None:
    result = capture.assess()
    for name in ("R", "B", "C", "D", "O", "G", "Z", "weight"):
        values = getattr(result, name)
        known = values[~np.isnan(values)]
        assert ((known >= 0.0) & (known <= 1.0)).all(), name


@given(captures())
def test_roles_are_ordered(capture: Capture) -> None:
    """Weights of strong frames >= those of geometric and auxiliary ones >= those of the other roles."""
    result = capture.assess()
    by_role = {role: result.weight[result.role == role] for role in Role}
    middle = [*by_role[Role.GEOMETRIC], *by_role[Role.AUXILIARY]]
    if len(by_role[Role.STRONG]):
        assert by_role[Role.STRONG].min() >= result.weight.max(where=result.role != Role.STRONG, initial=0.0)
    if middle:
        assert min(middle) >= max([*by_role[Role.REACTIVATED], *by_role[Role.SUPPRESSED]], default=0.0)
    assert not by_role[Role.SUPPRESSED].any()


@given(captures())
def test_every_bin_with_frames_has_an_active_one(capture: Capture) -> None:
    result = capture.assess()
    placed = result.bin >= 0
    assert set(result.bin[placed]) == set(result.bin[placed & (result.weight > 0.0)])
    # One frame per uncovered bin is reactivated.
    reactivated = result.bin[result.role == Role.REACTIVATED]
    assert len(reactivated) == len(set(reactivated))
    assert not result.covered[reactivated].any()


@given(captures(), st.floats(0.0, 1.0))
def test_active_share_holds_and_changes_only_suppressed_frames(capture: Capture, share: float) -> None:
    plain = capture.assess()
    held = replace(capture, config=capture.config.model_copy(update={"active_share": share})).assess()
    wanted = share * np.count_nonzero(held.bin >= 0)
    assert np.count_nonzero(held.weight) >= wanted - 1e-6
    changed = held.reactivated_for != plain.reactivated_for
    assert (plain.role[changed] == Role.SUPPRESSED).all()
    np.testing.assert_array_equal(held.weight[~changed], plain.weight[~changed])
    # No more frames than required are active.
    assert np.count_nonzero(held.weight) < wanted + 1.0 or not changed.any()


@given(captures(), st.randoms(use_true_random=False))
def test_permuting_the_rows_permutes_the_table(capture: Capture, random: Random) -> None:
    order = np.arange(len(capture.frame_id))
    random.shuffle(order)
    poses = Poses(*(getattr(capture.poses, f.name)[order] for f in fields(Poses)))
    shuffled = replace(capture, frame_id=capture.frame_id[order], cues=capture.cues[order], poses=poses)
    one, other = capture.assess(), shuffled.assess()
    for name in PER_FRAME:
        np.testing.assert_array_equal(getattr(one, name)[order], getattr(other, name), err_msg=name)


@given(captures())
def test_frames_without_pose_or_scores_have_no_effect(capture: Capture) -> None:
    """Without such frames the others get the same rows, bit for bit, and the same bins."""
    result = capture.assess()
    kept = capture.poses.registered & ~np.isnan(capture.cues[:, 0])
    poses = Poses(*(getattr(capture.poses, f.name)[kept] for f in fields(Poses)))
    without = replace(capture, frame_id=capture.frame_id[kept], cues=capture.cues[kept], poses=poses).assess()
    for name in PER_FRAME:
        np.testing.assert_array_equal(getattr(result, name)[kept], getattr(without, name), err_msg=name)
    np.testing.assert_array_equal(result.covered, without.covered)
    np.testing.assert_array_equal(result.bin_edges, without.bin_edges)
    assert not result.weight[~kept].any()


@given(captures(), st.integers(0, 23), st.integers(0, 23))
def test_a_point_shared_with_a_reliable_frame_raises_no_gain(capture: Capture, i: int, j: int) -> None:
    before = capture.assess()
    reference = np.flatnonzero(before.reliable | before.fallback)
    placed = np.flatnonzero(before.bin >= 0)
    if not len(placed):
        return
    i, j = placed[i % len(placed)], reference[j % len(reference)]
    seen = Observations(
        np.append(capture.observations.frame_id, capture.frame_id[[i, j]]),
        np.append(capture.observations.point_id, [999, 999]),
    )
    after = replace(capture, observations=seen).assess()
    assert after.C[i] <= before.C[i] + 1e-12


@given(captures())
def test_reliable_frames_are_strong_and_gain_no_coverage(capture: Capture) -> None:
    result = capture.assess()
    np.testing.assert_array_equal(result.reliable, result.role == Role.STRONG)
    assert not result.C[result.reliable].any()
    assert result.reliable.any() or result.fallback.any() or not (result.bin >= 0).any()
