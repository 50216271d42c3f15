"""The person, the thing and the screen of the protocols `moving` and `moving-severe`."""

from __future__ import annotations

import numpy as np
import pytest

from cleargs.synth.movers import HIDDEN, SEVERITIES, WALK_RADIUS, Household
from cleargs.synth.optics import Shutter
from cleargs.synth.path import HandheldPath
from cleargs.synth.raycast import RoomWorld, room_setup
from cleargs.synth.room import make_room

FRAMES, WIDTH, HEIGHT, SEED = 12, 64, 36, 3


def household(severity: int = 1) -> Household:
    return Household(make_room(SEED), 1.0, SEED, SEVERITIES[severity])


def filmed(share: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the truth, what is filmed, and the share of movement, at a share of the capture."""
    setup = room_setup(FRAMES, WIDTH, HEIGHT, SEED, moving=1)
    path = HandheldPath(setup.course, FRAMES, SEED)
    time = np.full(8, share * path.duration)
    shutter = Shutter(path.poses(time), np.zeros((8, HEIGHT), np.intp) + np.arange(8)[:, None], time)
    assert setup.film is not None
    return setup.world.render(shutter, setup.lens), *setup.film(shutter, setup.lens)


@pytest.mark.parametrize("severity", SEVERITIES)
def test_the_person_walks_the_thing_is_put_elsewhere_and_the_screen_flickers(severity: int) -> None:
    movers, rules = household(severity), SEVERITIES[severity]
    times = np.linspace(0, 1, 401)
    states = movers.states(times)
    at_first = (states[:, 0, :3] == movers.items[0]["centre"]).all(axis=1)
    begin, end = rules.elsewhere
    np.testing.assert_array_equal(at_first, (times <= begin) | (times >= end))
    assert at_first.mean() > 0.5  # most frames show it where the truth has it
    inside = (times > rules.flicker[0]) & (times < rules.flicker[1])
    np.testing.assert_array_equal(states[:, 1, 3] != 1.0, inside)
    seen = states[:, 2:, 1].min(axis=1) > 0.0
    walks = sum(end - begin for begin, end in rules.walks)
    assert seen.mean() == pytest.approx(walks, abs=0.02)
    from_focus = states[seen, 2:, :3][..., [0, 2]] - make_room(SEED).focus[[0, 2]]
    np.testing.assert_allclose(np.linalg.norm(from_focus, axis=-1), WALK_RADIUS)
    assert (states[~seen, 2:, 1] < HIDDEN + 2).all()


def test_a_frame_in_which_nothing_moves_is_the_truth() -> None:
    truth, light, share = filmed(0.05)
    # The person waits 1 km away, and takes about 1e-7 of the ambient light.
    np.testing.assert_allclose(light, truth, atol=1e-6)
    assert share.max() == 0.0


def test_the_person_is_in_the_frames_and_not_in_the_truth() -> None:
    truth, light, share = filmed(0.5)
    assert 0.05 < (share > 0.5).mean() < 0.6
    change = np.abs(light - truth).mean(axis=2)
    assert np.median(change[share > 0.99]) > 10 * np.median(change[share == 0.0])
    assert isinstance(room := room_setup(2, 8, 8, SEED, moving=1).world, RoomWorld)
    assert len(room.room.primitives) == len(make_room(SEED).primitives) + 2
