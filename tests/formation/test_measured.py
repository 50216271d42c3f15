"""Formation that starts from the motion that ingest measured in the video."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from cleargs.formation import capture, estimate
from cleargs.formation.capture import ESTIMATES_TO_KEEP, MEASURED_EVERY, CaptureFormation
from cleargs.formation.formed import render_formed
from cleargs.formation.frame import FrameFormation, filmed_as, packed, unpacked
from cleargs.formation.measured import MeasuredPath, load_paths
from cleargs.formation.motion import FrameMotion
from cleargs.formation.warp import displacement_fields
from cleargs.splat.config import FormationConfig
from cleargs.splat.views import TrainingView
from tests.formation.test_capture import BLURRED, FRAMES, LOOK, camera, run, scene, views

FRAME_S, EXPOSURE_S, READOUT_S = 1 / 30, 1 / 40, 0.02
FOCAL, DEPTH = 90.0, 3.0
SPEED = np.array([0.0, 0.0, 0.0, 0.3, 3.0, 0.0])  # world units and radians per second


def measured(readout: float = 0.0, error: float = 0.0, columns: bool = False) -> MeasuredPath:
    """Path of a camera that turns at `SPEED`, with an error of the measurement."""
    path = np.zeros((4, 6))
    path[0] = SPEED * (1.0 + error)
    covariance = np.diag(np.square([0.01, 0.01, 0.01, 0.1, 0.1, 0.1]))
    return MeasuredPath(path, covariance, FRAME_S, DEPTH, readout, columns)


def filmed(motions: dict[int, FrameFormation]) -> list[TrainingView]:
    """Views of the wall, with the motion of each camera."""
    made = []
    for index, angle in enumerate(np.linspace(-0.1, 0.1, FRAMES)):
        view = TrainingView(index, camera(angle), 1.0, "real", lambda: (None, None))
        seen = render_formed(scene(), view, formation=motions.get(index)).numpy()
        pixels = np.rint(255 * seen).astype(np.uint8)
        made.append(TrainingView(index, view.camera, 1.0, "real", lambda pixels=pixels: (pixels, None)))
    return made


def blurred() -> FrameFormation:
    motion = measured().exposed(EXPOSURE_S, camera(0.0))
    return FrameFormation(BLURRED, motion, "blur", displacement_px=4.0)


@pytest.mark.parametrize("error", [0.0, 0.1])
def test_a_measured_blur_needs_no_search(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: float
) -> None:
    """Only its exposure time is unknown."""
    monkeypatch.setattr(estimate, "search", None)
    seen = filmed({BLURRED: blurred()})
    formation = CaptureFormation(seen, LOOK, measured={k: measured(error=error) for k in range(FRAMES)})
    run(tmp_path, seen, formation)
    found = formation.frames
    assert {k for k, frame in found.items() if frame.model == "blur"} == {BLURRED}
    # Observed: 3.3 % without an error, 10 % with one, which the picture corrects in part.
    assert found[BLURRED].motion.exposure_s * (1.0 + error) == pytest.approx(EXPOSURE_S, rel=0.15)
    truth = blurred().motion.blur
    assert np.linalg.norm(found[BLURRED].motion.blur - truth) < 0.15 * np.linalg.norm(truth)
    assert found[BLURRED].explained > 0.5


def test_a_frame_that_follows_its_measured_motion_is_estimated_half_as_often(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    estimates: Counter[int] = Counter()

    def counted(frame: FrameFormation, *others: Any) -> FrameFormation:
        estimates[frame.frame_id] += 1
        return estimate.fit_motion(frame, *others)

    monkeypatch.setattr(capture, "fit_motion", counted)
    seen = filmed({BLURRED: blurred()})
    formation = CaptureFormation(seen, LOOK, measured={k: measured() for k in range(1, FRAMES)})
    run(tmp_path, seen, formation)
    for frame_id, frame in formation.frames.items():
        every = LOOK.every * (MEASURED_EVERY if frame_id > 0 else 1)
        assert estimates[frame_id] == math.ceil(frame.steps / every) > 1, frame_id


def test_a_later_training_counts_estimates_and_not_steps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After equal steps, a frame that follows its measured motion has had half of the estimates."""
    looked: set[int] = set()

    def look(frame: FrameFormation, *_: Any) -> FrameFormation:
        looked.add(frame.frame_id)
        return frame

    monkeypatch.setattr(capture, "fit_motion", look)
    steps = (ESTIMATES_TO_KEEP + 1) * LOOK.every
    known = {k: FrameFormation(k, steps=steps) for k in range(FRAMES)}
    seen = filmed({})
    run(tmp_path, seen, CaptureFormation(seen, LOOK, known=known, measured={1: measured()}))
    assert looked == {1}


def test_a_wrong_measurement_is_left_for_a_search(tmp_path: Path) -> None:
    """The photograph contradicts it."""
    seen = views()  # a blur across
    path = replace(measured(), path=np.zeros((4, 6)))
    path.path[0, 3] = 3.0  # measured: down
    formation = CaptureFormation(seen, LOOK, measured=dict.fromkeys(range(FRAMES), path))
    run(tmp_path, seen, formation)
    found = formation.frames[BLURRED]
    assert found.model == "blur" and found.searched and found.motion.exposure_s == 0.0
    assert abs(found.motion.blur[4]) == pytest.approx(7.0, abs=1.0)


@pytest.mark.parametrize("columns", [False, True])
def test_a_measured_skew_is_there_from_the_first_step(tmp_path: Path, columns: bool) -> None:
    path = measured(READOUT_S, columns=columns)
    skew = path.read(camera(0.0))
    seen = filmed({k: filmed_as(skew, k) for k in range(FRAMES)})
    formation = CaptureFormation(
        seen, FormationConfig(start=1.0), measured=dict.fromkeys(range(FRAMES), path)
    )
    assert {frame.model for frame in formation.frames.values()} == {"skew"}
    with_skew = run(tmp_path / "skew", seen, formation)
    without = run(tmp_path / "plain", seen, None)
    for trained, low in ((with_skew, True), (without, False)):
        shown = render_formed(trained.scene, filmed({})[0])
        off = float((shown - render_formed(scene(), filmed({})[0])).abs().mean())
        assert (off < 0.004) == low, off


def test_columns_are_rows_of_the_turned_picture() -> None:
    path = measured(READOUT_S)
    rows = path.read(camera(0.0))
    depth = torch.full((64, 96), DEPTH)
    alpha = torch.ones(64, 96)
    down = displacement_fields(rows, camera(0.0), depth, alpha).offset
    across = displacement_fields(replace(rows, columns=True), camera(0.0), depth, alpha).offset
    assert float(down[:, 0].abs().max()) > 0.5 and float(across[:, :, 0].abs().max()) > 0.5
    # The skew is 0 in the middle of the readout: the middle row, or the middle column.
    assert float(down[:, 31:33].abs().max()) < 0.1 and float(across[:, :, 47:49].abs().max()) < 0.1
    bent = displacement_fields(replace(rows, skew_bend=rows.skew), camera(0.0), depth, alpha).offset
    for row in (3, 40, 63):  # the skew of the row alone
        factor = 1.0 + (row + 0.5) / 64 - 0.5
        alone = displacement_fields(replace(rows, skew=factor * rows.skew), camera(0.0), depth, alpha).offset
        torch.testing.assert_close(bent[:, row], alone[:, row], atol=1e-4, rtol=1e-4)


def test_frames_with_little_blur_get_the_exposure_time_of_those_around(tmp_path: Path) -> None:
    """Four frames move fast and show it. The fifth moves slowly."""
    slow = replace(measured(), path=0.2 * measured().path)
    paths = {k: slow if k == 0 else measured() for k in range(FRAMES)}
    motions = {
        k: FrameFormation(k, path.exposed(EXPOSURE_S, camera(0.0)), "blur", displacement_px=4.0)
        for k, path in paths.items()
    }
    formation = CaptureFormation(filmed(motions), LOOK, measured=paths)
    run(tmp_path, filmed(motions), formation)
    times = {k: frame.motion.exposure_s for k, frame in formation.frames.items()}
    assert sum(times[k] == pytest.approx(EXPOSURE_S, rel=0.25) for k in range(1, FRAMES)) >= 2, times
    assert times[0] == pytest.approx(EXPOSURE_S, rel=0.25)


def test_a_run_of_an_older_version_has_no_measured_motion(tmp_path: Path) -> None:
    assert load_paths(tmp_path) == {}


def test_the_orders_of_an_exposure_follow_from_the_derivatives() -> None:
    """Places on the polynomial of the path equal those of the orthogonal polynomials."""
    path = replace(measured(), path=np.random.default_rng(0).normal(0, 1, (4, 6)) * [[1], [10], [100], [0]])
    motion = path.exposed(EXPOSURE_S, camera(0.0))
    scales = FOCAL * np.array([1 / DEPTH] * 3 + [1.0] * 3)
    for t in (-0.5, -0.1, 0.3, 0.5):
        time = t * EXPOSURE_S
        exact = sum(path.path[k] * time ** (k + 1) / (1, 2, 6)[k] for k in range(3)) * scales
        made = (
            motion.pose + t * motion.blur + (t * t - 1 / 12) * motion.bend + (t**3 - 3 * t / 20) * motion.cube
        )
        np.testing.assert_allclose(made, exact, atol=1e-9)
    assert isinstance(motion, FrameMotion) and motion.exposure_s == EXPOSURE_S


def test_a_checkpoint_keeps_every_bit_of_a_formation() -> None:
    """Also the sign of a zero: that of a readout of 0 s times a speed."""
    vector = np.random.default_rng(1).normal(0, 1, 36)
    vector[::5] = -0.0
    motion = FrameMotion(exposure_s=EXPOSURE_S, columns=True, median_depth=DEPTH).with_vector(vector)
    frame = FrameFormation(3, motion, "both", residual=0.1, skew_gain=0.2, blur_gain=0.05, steps=7)
    again = next(unpacked(packed([frame])))
    assert packed([again]).tobytes() == packed([frame]).tobytes()
    assert again.motion.vector.tobytes() == vector.tobytes()
