"""Rooms filmed by cameras that do not walk: pans, zooms, walls, turntables, flights, pauses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from cleargs.media.image import write_rgb
from cleargs.synth.optics import Lens, instant_shutter, phone_lens
from cleargs.synth.path import Orbit, look_at
from cleargs.synth.phone import develop
from cleargs.synth.raycast import RoomWorld
from cleargs.synth.room import (
    BOX,
    DEPTH,
    HEIGHT,
    PRINTS,
    ROD,
    SURFACES,
    WIDTH,
    Room,
    make_room,
    mip_levels,
    primitive,
)
from cleargs.synth.room import SIZE as TEXELS
from cleargs.types import ArrayF64, ImageU8

SIZE = (320, 240)
EYE = np.array([0.0, 1.4, 1.2])
"""A place in front of the table, metres."""


def zoomed(lens: Lens, factor: float) -> Lens:
    return replace(lens, fx=factor * lens.fx, fy=factor * lens.fy)


def shoot(room: Room, pose: ArrayF64, lens: Lens, number: int) -> ImageU8:
    """Return a sharp frame with the noise of a sensor."""
    light = RoomWorld(room).render(instant_shutter(pose, lens.height), lens)
    return develop(light, noise=1 / 255, rng=np.random.default_rng(number))


def film(
    room: Room, poses: ArrayF64, lenses: Sequence[Lens] | None = None, size: tuple[int, int] = SIZE
) -> Iterator[ImageU8]:
    for number, pose in enumerate(poses):
        yield shoot(room, pose, lenses[number] if lenses else phone_lens(*size), number)


def write(folder: Path, pictures: Iterator[ImageU8] | Sequence[ImageU8]) -> Path:
    folder.mkdir(parents=True)
    for number, picture in enumerate(pictures):
        write_rgb(folder / f"{number:04d}.png", picture)
    return folder


def walk(seed: int, frames: int) -> ArrayF64:
    """Return poses [F, 3, 4] of an arc around the table."""
    return Orbit(make_room(seed).focus, frames, seed).poses(np.linspace(0, 1, frames))


def pan(frames: int, degrees: float, eye: ArrayF64 = EYE, radius: float = 0.0, tilt: float = 0.0) -> ArrayF64:
    """Return poses that turn by ``degrees`` at one place, or on an arm of ``radius`` metres."""
    angles = np.radians(np.linspace(-degrees / 2, degrees / 2, frames))
    dips = np.radians(tilt) * np.sin(np.linspace(0, 2 * np.pi, frames))
    ahead = np.stack([np.sin(angles), np.sin(dips), -np.cos(angles)], 1)
    return np.stack([look_at(eye + radius * step, eye + (radius + 1) * step) for step in ahead])


def wall(seed: int) -> Room:
    """Return the room of ``seed`` with nothing in front of its back wall and its posters."""
    room = make_room(seed)
    middle, size = room.primitives["centre"], room.primitives["size"]
    flat = (middle[:, 2] < -DEPTH / 2 + 0.02) & (size[:, 2] < 0.02)
    flat[0] = True
    return replace(room, primitives=room.primitives[flat])


def along_wall(frames: int, away: float = 1.6) -> ArrayF64:
    """Return poses of a walk along the back wall that look straight at it."""
    x = np.linspace(-1.2, 1.2, frames)
    y = 1.45 + 0.1 * np.sin(np.linspace(0, 5, frames))
    eyes = np.stack([x, y, np.full(frames, -DEPTH / 2 + away)], 1)
    return np.stack([look_at(eye, eye - [0.3 * np.sin(2 * eye[0]), 0, 1]) for eye in eyes])


def flight(frames: int, height: float = 2.4, strips: int = 3, turned: bool = False) -> ArrayF64:
    """Return poses of a camera that looks straight down and flies in strips; ``turned``: nose first."""
    poses = []
    for number in range(frames):
        strip, share = divmod(number * strips / frames, 1)
        sign = 1 if int(strip) % 2 == 0 else -1
        x = -0.9 + 1.8 * strip / max(1, strips - 1) if strips > 1 else 0.0
        z = sign * (share - 0.5) * 2.4
        nose, ahead = np.array([0, 0, sign if turned else 1.0]), np.array([0, -1.0, 0])
        poses.append(np.stack([np.cross(-nose, ahead), -nose, ahead, [x, height, z]], 1))
    return np.stack(poses)


def turntable(seed: int, frames: int, size: tuple[int, int] = SIZE) -> Iterator[ImageU8]:
    """Yield pictures of things that turn before a still room."""
    room, lens = make_room(seed), phone_lens(*size)
    middle, reach = room.primitives["centre"], room.primitives["bound"]
    on_table = (middle[:, 1] > 0.7) & (np.abs(middle[:, [0, 2]] - room.focus[[0, 2]]) < 0.85).all(1)
    on_table &= (reach < 1.0) & (room.primitives["kind"] != ROD)
    shell, still = np.arange(len(on_table)) == 0, replace(room, primitives=room.primitives[~on_table])
    empty, things = (
        RoomWorld(replace(room, primitives=room.primitives[some])) for some in (shell, shell | on_table)
    )
    target = np.array([room.focus[0], 0.8, room.focus[2] + 0.3])
    eye = target + np.array([0.0, 0.55, 1.5])
    behind = RoomWorld(still).render(instant_shutter(look_at(eye, target), lens.height), lens)
    for number in range(frames):
        angle = 2 * np.pi * number / frames
        pose = look_at(target + np.array([1.5 * np.sin(angle), 0.55, 1.5 * np.cos(angle)]), target)
        light = things.render(instant_shutter(pose, lens.height), lens)
        seen = (things.depth(pose, lens) < empty.depth(pose, lens) - 1e-6)[..., None]
        yield develop(np.where(seen, light, behind), noise=1 / 255, rng=np.random.default_rng(number))


def text_wall(seed: int, frames: int, size: tuple[int, int], speed: int) -> Iterator[ImageU8]:
    """Yield pictures of a walk before a wall of text that moves up by ``speed`` texels per frame."""
    random, room = np.random.default_rng(seed), make_room(seed)
    page = np.full((TEXELS, TEXELS, 3), 240, np.uint8)
    for row in range(22, TEXELS, 22):
        line = " ".join("".join(random.choice([*"aeinorst"], 4)) for _ in range(12))
        left = int(random.integers(4, 44))
        cv2.putText(page, line, (left, row), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (60, 20, 20), 1, cv2.LINE_AA)
    middle = (0.0, HEIGHT / 2, -DEPTH / 2 + 0.03)
    wall = primitive(
        BOX, middle, (WIDTH / 2 - 0.05, HEIGHT / 2 - 0.01, 0.012), SURFACES + PRINTS, shadow=False
    )
    primitives = np.append(room.primitives, wall)
    for number, pose in enumerate(walk(seed, frames)):
        shown = mip_levels((np.roll(page, -speed * number, axis=0) / 255.0) ** 2.2)
        textures = np.concatenate([room.textures, shown[None]])
        yield shoot(replace(room, primitives=primitives, textures=textures), pose, phone_lens(*size), number)


def stabilised(seed: int, frames: int, crop: float = 1.1, shift: float = 0.04) -> Iterator[ImageU8]:
    """Yield the pictures of a walk after a crop whose place moves by ``shift`` of the width."""
    width, height = SIZE
    random = np.random.default_rng(seed)
    for picture in film(make_room(seed), walk(seed, frames)):
        across, down = shift * random.uniform(-1, 1, 2) * width
        zoom = np.array(
            [[crop, 0, width / 2 * (1 - crop) + across], [0, crop, height / 2 * (1 - crop) + down]]
        )
        yield np.asarray(cv2.warpAffine(picture, zoom, (width, height), flags=cv2.INTER_CUBIC), np.uint8)
