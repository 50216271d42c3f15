"""The camera's path from tracks, and the readout time from keypoints whose rows are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cleargs.capture.capture import Capture, SourceFrame
from cleargs.capture.motion import ORDER, TWIST, Tracks, measure, path_at, projected, spread_out, track
from cleargs.capture.neighbours import neighbourhoods, repeats
from cleargs.capture.readout import Geometry, Observations, estimate
from cleargs.types import ArrayF64

FOCAL, WIDTH, HEIGHT = 300.0, 320, 180
FRAME_S = 1 / 30
READOUT = 0.02
SPEED = np.array([0.3, -0.1, 0.2, 0.5, -0.9, 0.2])
CHANGE = np.array([1.0, 0.5, 0.0, 4.0, 6.0, -2.0])


def path(speed: ArrayF64 = SPEED, change: ArrayF64 = CHANGE) -> ArrayF64:
    return np.stack([speed, change, np.zeros(TWIST), np.zeros(TWIST)])


def tracks(readout: float = 0.0, noise: float = 0.1, count: int = 300) -> Tracks:
    """Points in front of a camera that moves along `path`, as a shutter of this readout sees them."""
    rng = np.random.default_rng(4)
    x, y = rng.uniform(-0.5, 0.5, count) * WIDTH / FOCAL, rng.uniform(-0.5, 0.5, count) * HEIGHT / FOCAL
    depth = rng.uniform(1.5, 5.0, count)
    points = np.stack([x * depth, y * depth, depth], 1)
    times = FRAME_S * np.array([0.0, -2.0, -1.0, 1.0, 2.0])
    places = np.zeros((len(times), count, 2))
    for k, time in enumerate(times):
        rows = np.zeros(count)
        for _ in range(6):  # a point is read at its row, which depends on when it is read
            seen, _ = projected(points, path_at(np.repeat(path()[None], count, 0), time + readout * rows))
            rows = seen[:, 1] * FOCAL / HEIGHT
        places[k] = seen + noise / FOCAL * rng.standard_normal(seen.shape)
    return Tracks(points, places, places[..., 1] * FOCAL / HEIGHT, times, FOCAL)


def in_image(twist: ArrayF64, seen: Tracks) -> float:
    """Return the mean motion of the points by a twist, px."""
    _, slopes = projected(seen.points, np.zeros((len(seen.points), TWIST)))
    return float(np.linalg.norm(FOCAL * slopes @ twist, axis=1).mean())


@pytest.mark.parametrize("readout", [0.0, READOUT, -READOUT])
def test_the_speed_of_a_camera_is_measured(readout: float) -> None:
    seen = tracks(readout)
    found = measure(seen, readout)
    assert found is not None
    # 0.1 px of noise in 300 tracks over two frames; observed: below 0.3 %.
    assert in_image(found.path[0] - SPEED, seen) < 0.01 * in_image(SPEED, seen)
    assert in_image(found.path[1] - CHANGE, seen) < 0.2 * in_image(CHANGE, seen)
    assert found.frame_s == pytest.approx(FRAME_S)
    if readout:  # without the readout the speed is wrong by more
        ignored = measure(seen)
        assert ignored is not None
        assert in_image(ignored.path[0] - SPEED, seen) > 3 * in_image(found.path[0] - SPEED, seen)


def test_wrong_tracks_do_not_count() -> None:
    seen = tracks()
    places = seen.places.copy()
    places[1:, ::5] += 0.1  # a fifth of the points move by 30 px on their own
    found = measure(replace(seen, places=places))
    assert found is not None
    assert in_image(found.path[0] - SPEED, seen) < 0.03 * in_image(SPEED, seen)


def test_the_first_frame_has_neighbours_on_one_side() -> None:
    seen = tracks()
    late = replace(
        seen, places=seen.places[[0, 3, 4]], rows=seen.rows[[0, 3, 4]], times=seen.times[[0, 3, 4]]
    )
    found, both = measure(late), measure(seen)
    assert found is not None and both is not None
    assert in_image(found.path[0] - SPEED, seen) < 0.05 * in_image(SPEED, seen)
    assert not found.path[2:].any()  # a path of second order
    assert np.trace(found.covariance) > np.trace(both.covariance)


def test_a_frame_needs_enough_tracks() -> None:
    seen = tracks()
    few = seen.places.copy()
    few[1:, 15:] = np.nan
    assert measure(replace(seen, places=few)) is None


def test_points_are_followed_and_lost_ones_are_left_out() -> None:
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (HEIGHT, WIDTH)).astype(np.float32), (0, 0), 4.0)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)

    def shifted(x: float, y: float) -> np.ndarray:
        return cv2.warpAffine(texture, np.float32([[1, 0, x], [0, 1, y]]), (WIDTH, HEIGHT)).astype(np.uint8)

    xy = np.stack(np.meshgrid(np.arange(30.5, 300, 20), np.arange(20.5, 160, 20)), -1).reshape(-1, 2)
    other = shifted(6.0, -3.0)
    other[:, 200:] = 128  # the right part is covered
    found = track(shifted(0, 0), [other, shifted(12.0, -6.0)], [1.0, 2.0], xy)
    left = xy[:, 0] < 170
    assert np.nanmax(np.abs(found[0, left] - xy[left] - (6.0, -3.0))) < 0.1
    assert np.isnan(found[0, xy[:, 0] > 220]).all()
    inside = (xy[:, 0] < 290) & (xy[:, 1] > 25)
    assert np.nanmax(np.abs(found[1, inside] - xy[inside] - (12.0, -6.0))) < 0.1
    assert np.isnan(found[0]).mean() > 0.2 and np.isfinite(found[1, inside & left]).mean() > 0.6


def test_keypoints_are_spread_over_the_picture() -> None:
    xy = np.random.default_rng(1).uniform(0, 100, (5000, 2))
    chosen = spread_out(xy, 100)
    assert len(chosen) == 100 and np.histogram(xy[chosen, 1], 5, (0, 100))[0].min() >= 15


def capture(readout: float, frames: int = 24, columns: bool = False, noise: float = 0.3) -> tuple:
    """Keypoints of a walk along an arc with a shaking hand, and the geometry of a reconstruction."""
    rng = np.random.default_rng(2)
    points = rng.uniform((-2, -1, -1), (2, 1, 1), (600, 3)) + np.array([0, 0, 4])
    angles = np.linspace(-0.4, 0.4, frames)
    rotations = Rotation.from_rotvec(np.outer(angles, [0.0, 1.0, 0.0])).as_matrix()
    translations = np.stack([-2 * np.sin(angles), np.zeros(frames), 0.4 - 0.4 * np.cos(angles)], 1)
    speeds = rng.normal(0, 1, (frames, TWIST)) * np.array([0.1, 0.1, 0.1, 0.6, 0.6, 0.3])
    paths = np.zeros((frames, ORDER, TWIST))
    paths[:, 0] = speeds
    frame, point = (a.ravel() for a in np.meshgrid(np.arange(frames), np.arange(len(points)), indexing="ij"))
    base = Observations(
        frame,
        point,
        np.zeros((len(frame), 2)),
        np.zeros(len(frame)),
        np.zeros(frames, int),
        np.array([FOCAL]),
        paths,
        np.ones(frames),
    )
    truth = Geometry(rotations, translations, points, np.ones(1), readout)
    side, size = (0, WIDTH) if columns else (1, HEIGHT)
    seen = base
    for _ in range(6):
        places = truth.places(seen)[0]
        seen = replace(seen, row=places[:, side] / size)
    places = places + noise * rng.standard_normal(places.shape)
    inside = (np.abs(places) < (WIDTH / 2, HEIGHT / 2)).all(axis=1)
    seen = replace(seen, tangents=places / FOCAL, row=places[:, side] / size).select(inside)
    return seen, replace(truth, readout=0.0)


@pytest.mark.parametrize(("readout", "columns"), [(READOUT, False), (-READOUT, False), (READOUT, True)])
def test_the_readout_time_is_found_with_its_sign(readout: float, columns: bool) -> None:
    """A camera held upside down reads the other way, one held sideways along the columns."""
    found = estimate(*capture(readout, columns=columns))
    assert found is not None and found.holds
    assert found.seconds == pytest.approx(readout, rel=0.05)
    low, high = found.interval
    assert low < readout < high
    assert found.rolled_px < 0.9 * found.still_px


def test_a_global_shutter_has_no_readout() -> None:
    found = estimate(*capture(0.0))
    assert found is None or not found.holds


def test_a_readout_of_the_rows_is_none_of_the_columns() -> None:
    seen, start = capture(READOUT)
    x = start.places(seen)[0][:, 0] / WIDTH
    found = estimate(replace(seen, row=x), start)
    assert found is None or not found.holds or abs(found.seconds) < 0.3 * READOUT


def test_halves_that_disagree_are_no_readout() -> None:
    """Something else than a shutter bends one half of the capture."""
    seen, start = capture(READOUT)
    seconds = np.where(seen.frame < 12, 1.0, -1.0)
    found = estimate(replace(seen, row=seen.row * seconds), start)
    assert found is None or not found.holds


def numbered(*numbers: int, chosen: tuple[int, ...], frame_rate: float | None = None) -> Capture:
    frames = {n: SourceFrame(f"images/{n:06d}.jpg", Path(f"images/{n:06d}.jpg")) for n in numbers}
    return Capture(
        "images",
        tuple(frames[n] for n in chosen),
        len(frames),
        available=tuple(frames.values()),
        frame_rate=frame_rate,
    )


def test_images_that_were_not_chosen_are_neighbours_by_their_numbers() -> None:
    found = neighbourhoods(numbered(*range(0, 40, 2), chosen=(0, 10, 38), frame_rate=15.0))
    first, middle, last = found
    assert middle.times == pytest.approx((-2 / 15, -1 / 15, 1 / 15, 2 / 15))
    assert [int(other.path.stem) for other in middle.others] == [6, 8, 12, 14]
    assert first.times == pytest.approx((1 / 15, 2 / 15)) and last.times == pytest.approx((-2 / 15, -1 / 15))


def test_a_gap_in_the_numbers_ends_a_neighbourhood() -> None:
    found = neighbourhoods(numbered(1, 2, 3, 4, 20, 21, 22, 23, chosen=(3, 20)))
    assert [(one.number, one.times) for one in found] == [(0, (-2.0, -1.0, 1.0)), (1, (1.0, 2.0))]
    assert not neighbourhoods(numbered(1, chosen=(1,)))


def test_repeated_frames_are_noticed() -> None:
    rng = np.random.default_rng(3)
    shown = [rng.integers(0, 255, (40, 60), np.uint8) for _ in range(5)]
    assert not repeats(shown)
    assert repeats([shown[0], shown[1], shown[1], shown[3], shown[4]])


def test_a_folder_of_which_all_images_are_taken_has_no_neighbours() -> None:
    """Photographs have numbers too. The motion between them is not that during their exposure."""
    assert not neighbourhoods(numbered(*range(27), chosen=tuple(range(27))))
    assert neighbourhoods(numbered(*range(54), chosen=tuple(range(0, 54, 2))))
