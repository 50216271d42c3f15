"""A procedural room with textured walls, posters, furniture, balls and thin rods.

Textures are seeded and periodic. They have detail at all scales, so that SIFT finds features on all surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cleargs.random_streams import Stream
from cleargs.types import ArrayF32, ArrayF64

BOX, SPHERE, ROD = 0, 1, 2

SIZE = 512
"""Side of the finest mip level, in texels."""
TEXELS_PER_METRE = 256.0
LEVELS = 8
LEVEL_STARTS = tuple(sum((SIZE >> finer) ** 2 for finer in range(level)) for level in range(LEVELS))
"""Index of the first texel of each mip level in a texture."""
SURFACES, PRINTS = 8, 6
"""Number of material textures and of posters."""


def _noise(rng: np.random.Generator, slope: float, stretch: float = 1.0) -> ArrayF64:
    """Return periodic 1/f^slope noise of zero mean and unit variance, longer along x for ``stretch`` > 1."""
    frequency_y = np.fft.fftfreq(SIZE)[:, None]
    frequency_x = np.fft.rfftfreq(SIZE)[None, :] * stretch
    radius = np.hypot(frequency_x, frequency_y)
    radius[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal((SIZE, SIZE))) / radius**slope
    noise = np.fft.irfft2(spectrum, (SIZE, SIZE))
    return np.asarray(noise / noise.std(), np.float64)


def _mix(mask: ArrayF64, low: ArrayF64, high: ArrayF64) -> ArrayF64:
    return low + (high - low) * mask[..., None]


def _surface(rng: np.random.Generator) -> ArrayF64:
    """Return a texture like plaster, cloth or wood: two tones mixed by noise, grain and dark blotches."""
    base = rng.uniform(0.25, 0.75, 3)
    stretch = rng.choice([1.0, 1.0, 8.0])
    tone = 1 / (1 + np.exp(-2.5 * _noise(rng, 1.1, stretch)))
    blotch = (_noise(rng, 0.9) > 1.1).astype(np.float64)
    texture = _mix(tone, base * rng.uniform(0.4, 0.7), np.clip(base * rng.uniform(1.1, 1.4), 0, 0.95))
    texture = _mix(0.7 * blotch, texture, texture * rng.uniform(0.2, 0.6, 3))
    return texture * (1 + 0.12 * _noise(rng, 0.3)[..., None])


def _print(rng: np.random.Generator) -> ArrayF64:
    """Return a poster: rectangles, discs, lines and letters on a tinted ground, wrapped at the edges."""
    canvas = np.empty((SIZE, SIZE, 3), np.uint8)
    canvas[:] = rng.integers(128, 240, 3)
    for _ in range(140):
        size = float(SIZE * np.exp(rng.uniform(np.log(0.015), np.log(0.22))))
        centre = rng.uniform(0, SIZE, 2)
        colour = tuple(int(v) for v in rng.integers(5, 240, 3))
        shape = rng.integers(4)
        patch = np.roll(canvas, tuple((SIZE // 2 - centre).astype(int)), (1, 0)).copy()
        middle = (SIZE // 2, SIZE // 2)
        if shape == 0:
            cv2.circle(patch, middle, max(int(size / 2), 1), colour, -1, cv2.LINE_AA)
        elif shape == 1:
            box = cv2.boxPoints((middle, (size, size * rng.uniform(0.2, 1)), rng.uniform(0, 180)))
            cv2.fillConvexPoly(patch, box.astype(np.int32), colour, cv2.LINE_AA)
        elif shape == 2:
            end = tuple(int(SIZE // 2 + v) for v in rng.uniform(-size, size, 2))
            cv2.line(patch, middle, end, colour, max(int(size / 12), 1), cv2.LINE_AA)
        else:
            letter = chr(int(rng.integers(ord("A"), ord("Z") + 1)))
            cv2.putText(patch, letter, middle, cv2.FONT_HERSHEY_DUPLEX, size / 40, colour, 2, cv2.LINE_AA)
        canvas = np.roll(patch, tuple((centre - SIZE // 2).astype(int)), (1, 0))
    return canvas / 255 * (1 + 0.05 * _noise(rng, 0.5)[..., None])


def make_textures(rng: np.random.Generator) -> ArrayF32:  # [textures, texels of all levels, 3]
    """Return `SURFACES` materials, then `PRINTS` posters, with box-filtered mip levels, in linear RGB."""
    images = [_surface(rng) for _ in range(SURFACES)] + [_print(rng) for _ in range(PRINTS)]
    return np.stack([mip_levels(image) for image in images])


def mip_levels(image: ArrayF64) -> ArrayF32:  # [SIZE, SIZE, 3] linear RGB -> [texels of all levels, 3]
    """Return the box-filtered mip levels of a texture."""
    current, chain = np.clip(image, 0.01, 0.98), []
    for _ in range(LEVELS):
        chain.append(current.reshape(-1, 3).astype(np.float32))
        current = (current[::2, ::2] + current[1::2, ::2] + current[::2, 1::2] + current[1::2, 1::2]) / 4
    return np.concatenate(chain)


PRIMITIVE = np.dtype(
    [
        ("kind", np.int64),
        ("centre", np.float64, (3,)),
        ("rotation", np.float64, (3, 3)),  # rows: the primitive's own axes in the world
        ("size", np.float64, (3,)),  # half sides; radius first for a sphere; radius, half length for a rod
        ("texture", np.int64),
        ("gloss", np.float64),  # strength of the highlight, 0 for a matt surface
        ("bound", np.float64),  # radius of the bounding sphere
        # Radius of the ball that replaces the primitive in ambient occlusion; 0: it casts no shadow.
        ("shade", np.float64),
    ]
)


@dataclass(frozen=True)
class Room:
    """Room for the ray caster, in metres, with y up and the floor at y = 0."""

    primitives: NDArray[np.void]  # [P] of PRIMITIVE; the first is the room itself, seen from inside
    textures: ArrayF32  # [T, texels of all levels, 3] linear RGB
    light: ArrayF64  # [3] position of the lamp
    focus: ArrayF64  # [3] target of the camera


WIDTH, HEIGHT, DEPTH = 5.0, 2.7, 4.5
"""Size of the room, metres."""
FLOOR = 0.004
"""Half the thickness of the floor covering, metres."""


def primitive(
    kind: int,
    centre: tuple[float, float, float],
    size: tuple[float, float, float],
    texture: int,
    *,
    yaw: float = 0.0,
    tilt: float = 0.0,
    gloss: float = 0.0,
    shadow: bool = True,
) -> NDArray[np.void]:
    """Return a scalar of `PRIMITIVE`: a box, sphere or rod with its axes turned, angles in radians."""
    cy, sy, ct, st = np.cos(yaw), np.sin(yaw), np.cos(tilt), np.sin(tilt)
    turn = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]) @ np.array([[1, 0, 0], [0, ct, -st], [0, st, ct]])
    bound = size[0] if kind == SPHERE else float(np.linalg.norm(size))
    shade = {BOX: float(np.cbrt(np.prod(size))), SPHERE: size[0], ROD: 0.0}[kind] if shadow else 0.0
    return np.array((kind, centre, turn.T, size, texture, gloss, bound, shade), PRIMITIVE)


def make_room(seed: int) -> Room:
    """Return the room of ``seed``. Rooms have similar layouts, but other furniture, textures and light."""
    rng = np.random.default_rng([seed, Stream.ROOM])
    textures = make_textures(rng)

    def material() -> int:
        return int(rng.integers(SURFACES))

    items = [primitive(BOX, (0, HEIGHT / 2, 0), (WIDTH / 2, HEIGHT / 2, DEPTH / 2), 0, shadow=False)]
    floor = (WIDTH / 2, FLOOR, DEPTH / 2)
    items.append(primitive(BOX, (0, FLOOR, 0), floor, 1, gloss=0.15, shadow=False))

    for number in range(5):  # posters on the back wall and on both side walls
        poster = SURFACES + number % PRINTS
        half = (rng.uniform(0.3, 0.55), rng.uniform(0.3, 0.5), 0.015)
        if number < 3:
            x = (number - 1) * 1.55 + rng.uniform(-0.15, 0.15)
            centre = (x, rng.uniform(1.35, 1.75), -DEPTH / 2 + 0.015)
            items.append(primitive(BOX, centre, half, poster, gloss=0.25, shadow=False))
        else:
            side = 1.0 if number == 3 else -1.0
            centre = (side * (WIDTH / 2 - 0.015), rng.uniform(1.2, 1.6), rng.uniform(-1.3, -0.3))
            items.append(primitive(BOX, centre, half, poster, yaw=np.pi / 2, shadow=False))

    table = (rng.uniform(-0.2, 0.2), 0.72, rng.uniform(-0.75, -0.55))
    items.append(primitive(BOX, table, (0.75, 0.03, 0.42), material(), gloss=0.2))
    for dx in (-0.68, 0.68):  # its legs
        for dz in (-0.36, 0.36):
            leg = (table[0] + dx, 0.345, table[2] + dz)
            items.append(primitive(ROD, leg, (0.025, 0.345, 0), material()))
    for _ in range(4):  # boxes and balls on the table
        half = tuple(rng.uniform(0.06, 0.14, 3))
        centre = (table[0] + rng.uniform(-0.6, 0.6), 0.75 + half[1], table[2] + rng.uniform(-0.28, 0.28))
        texture = SURFACES + int(rng.integers(PRINTS))
        items.append(primitive(BOX, centre, half, texture, yaw=rng.uniform(0, np.pi)))
    for _ in range(2):
        radius = rng.uniform(0.07, 0.12)
        centre = (table[0] + rng.uniform(-0.55, 0.55), 0.75 + radius, table[2] + rng.uniform(-0.25, 0.3))
        items.append(primitive(SPHERE, centre, (radius, 0, 0), material(), gloss=0.8))
    for side in (-1.0, 1.0):  # a cupboard and a shelf on either side of the table
        half = (rng.uniform(0.25, 0.4), rng.uniform(0.45, 0.8), rng.uniform(0.2, 0.3))
        centre = (side * rng.uniform(1.5, 1.9), half[1], -DEPTH / 2 + half[2] + rng.uniform(0.02, 0.4))
        items.append(primitive(BOX, centre, half, material(), yaw=rng.uniform(-0.3, 0.3)))
    for _ in range(3):  # crates on the floor
        half = tuple(rng.uniform(0.12, 0.25, 3))
        centre = (rng.uniform(-1.6, 1.6), half[1], rng.uniform(0.0, 0.6))
        items.append(primitive(BOX, centre, half, material(), yaw=rng.uniform(0, np.pi)))
    for _ in range(4):  # thin rods, slightly tilted
        centre = (rng.uniform(-1.8, 1.8), rng.uniform(0.7, 0.9), rng.uniform(-1.8, -0.9))
        size = (rng.uniform(0.008, 0.02), rng.uniform(0.6, 0.8), 0.0)
        items.append(
            primitive(ROD, centre, size, material(), yaw=rng.uniform(0, 6), tilt=rng.uniform(0, 0.3))
        )

    light = np.array([rng.uniform(-1.2, 1.2), HEIGHT - 0.3, rng.uniform(0.2, 1.2)])
    return Room(np.array(items, PRIMITIVE), textures, light, np.array([table[0], 0.95, table[2] - 0.3]))
