"""Movement in a room: a balloon, or a person, a thing that is put elsewhere and a screen that flickers.

The truth has no balloon and no person. It has the thing at its first place, where most frames show it, and
the screen without flicker.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cleargs.random_streams import Stream
from cleargs.synth.room import BOX, PRINTS, SPHERE, SURFACES, Room, primitive
from cleargs.types import ArrayF64

SWAY = np.array([0.75, 0.08, 0.2])
"""Amplitude of a balloon's motion per axis, metres."""

WALK_RADIUS, WALK_ANGLE = 1.1, np.radians(75)
"""Arc on which a person walks between camera and table: radius around the focus, metres, and the angle at
either end, radians."""
HIDDEN = -1000.0
"""Height of a person outside the room, metres, too far away to change the ambient light."""
FLICKERS_PER_SECOND, FLICKER_STOPS = 12.0, 1.5
"""Changes of the screen's brightness, and the largest change in stops."""


class Balloon:
    """A ball that moves back and forth above the table of a room.

    It touches nothing. It crosses the view from side to side in two or three seconds.
    """

    resting = 0
    """Number of items that the room also contains, at rest: the first items, and its last primitives."""

    def __init__(self, room: Room, seed: int) -> None:
        rng = np.random.default_rng([seed, Stream.BALLOON])
        centre = (room.focus[0], 1.36, room.focus[2] + 0.45)
        texture = SURFACES + int(rng.integers(PRINTS))
        self.items = np.array([primitive(SPHERE, centre, (0.11, 0, 0), texture, gloss=0.5)])
        """Things that move or change, [M] of `cleargs.synth.room.PRIMITIVE`."""
        self._rates = 2 * np.pi / rng.uniform(4, 6, 3)  # radians per second
        self._phases = rng.uniform(0, 2 * np.pi, 3)

    def states(self, times: ArrayF64) -> ArrayF64:
        """Return the centres and the brightness (1: unchanged) [..., M, 4] at ``times`` [...], seconds."""
        centres = self.items[0]["centre"] + SWAY * np.sin(self._rates * times[..., None] + self._phases)
        return np.concatenate([centres, np.ones((*times.shape, 1))], -1)[..., None, :]


@dataclass(frozen=True)
class Severity:
    """Movement of a capture."""

    walks: tuple[tuple[float, float], ...]
    """Begin and end of each walk across the view, shares of the capture; every second walk goes back."""
    elsewhere: tuple[float, float]
    """Begin and end of the time in which the thing is at its second place, shares of the capture."""
    flicker: tuple[float, float]
    """Begin and end of the screen's flicker, shares of the capture."""
    thing: float
    """Half the height of the thing that is put elsewhere, metres."""


SEVERITIES = {
    1: Severity(walks=((0.3, 0.7),), elsewhere=(0.5, 0.75), flicker=(0.1, 0.4), thing=0.14),
    2: Severity(walks=((0.0, 0.48), (0.52, 1.0)), elsewhere=(0.4, 0.8), flicker=(0.1, 0.6), thing=0.24),
}
"""`Protocol.moving` -> severity. The person is in view in about a third (1) or two thirds (2) of frames."""


class Household:
    """A person who walks through, a thing that is put elsewhere and back, and a screen that flickers.

    ``room`` does not contain them. The capture takes ``duration`` seconds.
    """

    def __init__(self, room: Room, duration: float, seed: int, severity: Severity) -> None:
        rng = np.random.default_rng([seed, Stream.HOUSEHOLD])
        self._severity, self._duration, self._focus = severity, duration, room.focus
        table = room.focus + np.array([0.0, -0.2, 0.3])  # the middle of its top
        prints = [SURFACES + int(number) for number in rng.permutation(PRINTS)[:2]]
        screen = (table[0] + rng.uniform(-0.25, 0.25), table[1] + 0.24, table[2] - 0.34)
        height = severity.thing
        side = float(rng.choice([-1.0, 1.0]))
        first, second = (
            (table[0] + sign * rng.uniform(0.3, 0.5), table[1] + height, table[2] + 0.24)
            for sign in (side, -side)
        )
        self._second = np.array(second)
        resting = [
            primitive(
                BOX, first, (0.8 * height, height, 0.6 * height), prints[0], yaw=rng.uniform(-0.5, 0.5)
            ),
            primitive(BOX, screen, (0.34, 0.22, 0.015), prints[1]),
        ]
        legs, torso, head = (int(number) for number in rng.permutation(SURFACES)[:3])
        person = [
            primitive(BOX, (0, HIDDEN + 0.42, 0), (0.15, 0.42, 0.12), legs),
            primitive(BOX, (0, HIDDEN + 1.14, 0), (0.23, 0.30, 0.15), torso),
            primitive(SPHERE, (0, HIDDEN + 1.6, 0), (0.13, 0, 0), head),
        ]
        self.room = replace(room, primitives=np.concatenate([room.primitives, np.array(resting)]))
        """The room of the truth, with the thing and the screen."""
        self.items, self.resting = np.array([*resting, *person]), len(resting)
        self._stops = rng.uniform(0.5, 1.0, 4096) * rng.choice([-1.0, 1.0], 4096) * FLICKER_STOPS

    def states(self, times: ArrayF64) -> ArrayF64:
        """Return what `Balloon.states` returns. The last three items are the person."""
        shares = times / self._duration
        states = np.ones((*times.shape, len(self.items), 4))
        states[..., :3] = self.items["centre"]
        begin, end = self._severity.elsewhere
        states[(shares > begin) & (shares < end), 0, :3] = self._second
        begin, end = self._severity.flicker
        stops = self._stops[np.floor(times * FLICKERS_PER_SECOND).astype(np.intp) % len(self._stops)]
        states[..., 1, 3] = np.where((shares > begin) & (shares < end), 2.0**stops, 1.0)
        for number, (begin, end) in enumerate(self._severity.walks):
            angle = (2 * (shares - begin) / (end - begin) - 1) * WALK_ANGLE * (1 - 2 * (number % 2))
            inside = (shares > begin) & (shares < end)
            place = np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], -1) * WALK_RADIUS
            place += self._focus * [1.0, 0.0, 1.0] - [0.0, HIDDEN, 0.0]
            states[inside, 2:, :3] += place[inside][:, None]
        return states
