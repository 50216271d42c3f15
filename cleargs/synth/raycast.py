"""A small ray caster for the room, in Numba.

It shares no code with the splatting core, so that ground truth does not share that core's errors. Each image
is the mean of samples. A sample casts one jittered ray per pixel, with one camera pose per row and one point
on the lens. This gives anti-aliasing, motion blur, rolling shutter and defocus.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from cleargs.kernel_cache import configure_numba
from cleargs.synth.movers import SEVERITIES, Balloon, Household
from cleargs.synth.optics import PINHOLE, Aperture, Lens, Shutter, low_discrepancy, phone_lens
from cleargs.synth.path import FPS, Orbit, SceneSetup
from cleargs.synth.room import BOX, LEVEL_STARTS, LEVELS, SIZE, SPHERE, TEXELS_PER_METRE, Room, make_room
from cleargs.types import ArrayF64

configure_numba("raycast")

MISS = 1e30
"""Distance of a ray that hits nothing."""
AMBIENT = 0.42
LAMP = 1.9
PENUMBRA, CONTACT = 0.1, 0.015
"""Half width of the soft edge of a shadow: as a share of the distance to the object, plus metres."""
OCCLUSION = 0.8


@njit(cache=True, inline="always", error_model="numpy")
def _dot(a: ArrayF64, b: ArrayF64) -> float:
    total: float = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return total


@njit(cache=True, error_model="numpy")
def _hit_box(origin: ArrayF64, ray: ArrayF64, half: ArrayF64, normal: ArrayF64) -> float:
    """Return the distance to a box at the origin with half sides ``half``, from outside or inside."""
    near, far, near_axis, far_axis = -MISS, MISS, 0, 0
    for axis in range(3):
        speed = ray[axis] if abs(ray[axis]) > 1e-12 else 1e-12
        first = (-half[axis] - origin[axis]) / speed
        last = (half[axis] - origin[axis]) / speed
        if first > last:
            first, last = last, first
        if first > near:
            near, near_axis = first, axis
        if last < far:
            far, far_axis = last, axis
    if near > far or far < 1e-6:
        return MISS
    inside = near < 1e-6
    axis = far_axis if inside else near_axis
    normal[0], normal[1], normal[2] = 0.0, 0.0, 0.0
    normal[axis] = -1.0 if ray[axis] > 0 else 1.0
    return far if inside else near


@njit(cache=True, error_model="numpy")
def _hit_sphere(origin: ArrayF64, ray: ArrayF64, radius: float, normal: ArrayF64) -> float:
    half = _dot(origin, ray)
    root = half * half - _dot(origin, origin) + radius * radius
    if root < 0:
        return MISS
    distance: float = -half - math.sqrt(root)
    if distance < 1e-6:
        return MISS
    for axis in range(3):
        normal[axis] = (origin[axis] + distance * ray[axis]) / radius
    return distance


@njit(cache=True, error_model="numpy")
def _hit_rod(origin: ArrayF64, ray: ArrayF64, radius: float, half_length: float, normal: ArrayF64) -> float:
    """Return the distance to an open cylinder about the y axis."""
    a = ray[0] * ray[0] + ray[2] * ray[2]
    b = origin[0] * ray[0] + origin[2] * ray[2]
    root = b * b - a * (origin[0] * origin[0] + origin[2] * origin[2] - radius * radius)
    if a < 1e-12 or root < 0:
        return MISS
    distance: float = (-b - math.sqrt(root)) / a
    if distance < 1e-6 or abs(origin[1] + distance * ray[1]) > half_length:
        return MISS
    normal[0] = (origin[0] + distance * ray[0]) / radius
    normal[1] = 0.0
    normal[2] = (origin[2] + distance * ray[2]) / radius
    return distance


@njit(cache=True, error_model="numpy")
def _texture_coordinates(kind: int, point: ArrayF64, normal: ArrayF64, size: ArrayF64, uv: ArrayF64) -> None:
    """Write the position on the surface in metres to ``uv``. Each face of a box has another offset."""
    if kind == BOX:
        axis = 0
        for candidate in range(1, 3):
            if abs(normal[candidate]) > abs(normal[axis]):
                axis = candidate
        face = axis * 2 + (1 if normal[axis] > 0 else 0)
        uv[0] = point[2] if axis == 0 else point[0]
        uv[1] = point[2] if axis == 1 else -point[1]
        uv[0] += 0.37 * face
        uv[1] += 0.61 * face
    elif kind == SPHERE:
        uv[0] = math.atan2(point[2], point[0]) * size[0]
        uv[1] = math.asin(min(1.0, max(-1.0, point[1] / size[0]))) * size[0]
    else:
        uv[0] = math.atan2(point[2], point[0]) * size[0]
        uv[1] = point[1]


@njit(cache=True, error_model="numpy")
def _sample(texture: NDArray[np.float32], uv: ArrayF64, footprint: float, colour: ArrayF64) -> None:
    """Look up a texture trilinearly; ``footprint`` is the size of a pixel on the surface, in metres."""
    level = min(max(math.log2(max(footprint * TEXELS_PER_METRE, 1e-6)), 0.0), LEVELS - 1.001)
    colour[0], colour[1], colour[2] = 0.0, 0.0, 0.0
    for step in range(2):
        mip = int(level) + step
        share = (level - int(level)) if step else 1 - (level - int(level))
        side = SIZE >> mip
        x = uv[0] * TEXELS_PER_METRE / (1 << mip) - 0.5
        y = uv[1] * TEXELS_PER_METRE / (1 << mip) - 0.5
        column, row = math.floor(x), math.floor(y)
        for corner in range(4):
            right, down = corner & 1, corner >> 1
            weight = share * ((x - column) if right else 1 - (x - column))
            weight *= (y - row) if down else 1 - (y - row)
            texel = int(row + down) % side * side + int(column + right) % side
            for channel in range(3):
                colour[channel] += weight * texture[LEVEL_STARTS[mip] + texel, channel]


@njit(cache=True, error_model="numpy")
def _to_local(item: np.void, vector: ArrayF64, shift: bool, local: ArrayF64) -> None:
    """Transform a direction (or with ``shift`` a point) to the primitive's axes."""
    centre, rotation = item["centre"], item["rotation"]
    x = vector[0] - centre[0] if shift else vector[0]
    y = vector[1] - centre[1] if shift else vector[1]
    z = vector[2] - centre[2] if shift else vector[2]
    for axis in range(3):
        local[axis] = rotation[axis, 0] * x + rotation[axis, 1] * y + rotation[axis, 2] * z


@njit(cache=True, error_model="numpy")
def _cover_of_sphere(to_centre: ArrayF64, radius: float, to_light: ArrayF64, reach: float) -> float:
    """Return the share of the lamp, 0 to 1, that a ball hides from a point; the lamp is at ``reach`` m."""
    along = _dot(to_centre, to_light)
    if along <= 0.0 or along >= reach:
        return 0.0
    distance = math.sqrt(max(_dot(to_centre, to_centre) - along * along, 0.0))
    penumbra = PENUMBRA * along + CONTACT
    return min(max((radius + penumbra - distance) / (2 * penumbra), 0.0), 1.0)


@njit(cache=True, error_model="numpy")
def _cover_of_box(point: ArrayF64, ray: ArrayF64, half: ArrayF64, reach: float) -> float:
    """Return the share of the lamp, 0 to 1, that a box hides from ``point``; vectors are in the box's axes.

    The share depends on the distance between the box's nearest face and the middle of the ray in the box. The
    soft edge is as wide as the penumbra, or as the box if that is thinner.
    """
    near, far = -MISS, MISS
    for axis in range(3):
        speed = ray[axis] if abs(ray[axis]) > 1e-9 else 1e-9
        first, last = (-half[axis] - point[axis]) / speed, (half[axis] - point[axis]) / speed
        near, far = max(near, min(first, last)), min(far, max(first, last))
    along = 0.5 * (near + far)
    if along <= 0.0 or along >= reach:
        return 0.0
    penumbra = PENUMBRA * along + CONTACT
    cover = 1.0
    for axis in range(3):
        room = half[axis] - abs(point[axis] + along * ray[axis])
        cover = min(cover, room / min(2 * penumbra, 2 * half[axis]) + 0.5)
    return min(max(cover, 0.0), 1.0)


@njit(cache=True, error_model="numpy")
def _light_at(
    point: ArrayF64,
    normal: ArrayF64,
    to_light: ArrayF64,
    reach: float,
    primitives: NDArray[np.void],
    own: int,
    scratch: ArrayF64,  # [3, 3]
) -> tuple[float, float]:
    """Return the shares of the lamp and of the ambient light that reach ``point`` (0 dark, 1 lit)."""
    lit, ambient = 1.0, 1.0
    to_centre, local_point, local_ray = scratch[0], scratch[1], scratch[2]
    for number in range(1, primitives.shape[0]):
        item = primitives[number]
        if item["shade"] == 0.0 or number == own:
            continue
        centre, radius = item["centre"], item["shade"]
        for axis in range(3):
            to_centre[axis] = centre[axis] - point[axis]
        away = _dot(to_centre, to_centre)
        rise = _dot(to_centre, normal)
        if rise > 0.0:  # ambient occlusion by a ball of the primitive's size
            ambient *= 1 - OCCLUSION * min(radius * radius / away, 1.0) * rise / math.sqrt(away)
        along = _dot(to_centre, to_light)
        margin = item["bound"] + PENUMBRA * max(along, 0.0) + CONTACT
        if away - along * along > margin * margin:
            continue
        if item["kind"] == BOX:
            _to_local(item, point, True, local_point)
            _to_local(item, to_light, False, local_ray)
            cover = _cover_of_box(local_point, local_ray, item["size"], reach)
        else:
            cover = _cover_of_sphere(to_centre, radius, to_light, reach)
        lit *= 1 - 0.85 * cover * cover * (3 - 2 * cover)
    return lit, ambient


@njit(cache=True, error_model="numpy")
def _trace(
    origin: ArrayF64,
    ray: ArrayF64,
    pixel_angle: float,
    primitives: NDArray[np.void],
    textures: NDArray[np.float32],
    light: ArrayF64,
    colour: ArrayF64,
    scratch: ArrayF64,  # [10, 3], so that a ray allocates nothing
) -> tuple[float, int]:
    """Write the radiance along a ray to ``colour``. Return the distance and index of the hit primitive."""
    best, hit = MISS, 0
    normal, best_normal, local_point, local_ray = scratch[0], scratch[1], scratch[2], scratch[3]
    for number in range(primitives.shape[0]):
        item = primitives[number]
        centre, bound = item["centre"], item["bound"]
        x, y, z = centre[0] - origin[0], centre[1] - origin[1], centre[2] - origin[2]
        along = x * ray[0] + y * ray[1] + z * ray[2]
        if x * x + y * y + z * z - along * along > bound * bound:
            continue  # the ray misses the sphere around the primitive
        _to_local(item, origin, True, local_point)
        _to_local(item, ray, False, local_ray)
        if item["kind"] == BOX:
            distance = _hit_box(local_point, local_ray, item["size"], normal)
        elif item["kind"] == SPHERE:
            distance = _hit_sphere(local_point, local_ray, item["size"][0], normal)
        else:
            distance = _hit_rod(local_point, local_ray, item["size"][0], item["size"][1], normal)
        if distance < best:
            best, hit = distance, number
            best_normal[0], best_normal[1], best_normal[2] = normal[0], normal[1], normal[2]
    item = primitives[hit]
    point, world_normal, to_light = scratch[4], scratch[5], scratch[6]
    reach = 0.0
    for k in range(3):
        point[k] = origin[k] + best * ray[k]
        to_light[k] = light[k] - point[k]
        reach += to_light[k] * to_light[k]
        world_normal[k] = 0.0
        for axis in range(3):
            world_normal[k] += best_normal[axis] * item["rotation"][axis, k]
    reach = math.sqrt(reach)
    for k in range(3):
        to_light[k] /= reach
    _to_local(item, point, True, local_point)
    facing = max(abs(_dot(world_normal, ray)), 0.05)
    _texture_coordinates(item["kind"], local_point, best_normal, item["size"], local_ray)
    _sample(textures[item["texture"]], local_ray, best * pixel_angle / facing, colour)

    lit, ambient = _light_at(point, world_normal, to_light, reach, primitives, hit, scratch[7:10])
    diffuse = max(_dot(world_normal, to_light), 0.0) * lit * LAMP / (1 + 0.25 * reach * reach)
    # Ambient light also decreases near the walls.
    for axis in range(3):
        gap = primitives[0]["size"][axis] - abs(point[axis] - primitives[0]["centre"][axis])
        ambient *= 1 - 0.35 * math.exp(-max(gap, 0.0) / 0.25)
    highlight = 0.0
    if item["gloss"] > 0:  # Blinn-Phong
        facing_half, norm = 0.0, 0.0
        for k in range(3):
            half = to_light[k] - ray[k]
            norm += half * half
            facing_half += world_normal[k] * half
        highlight = 0.6 * item["gloss"] * lit * max(facing_half / math.sqrt(norm), 0.0) ** 40
    for channel in range(3):
        colour[channel] = colour[channel] * (AMBIENT * ambient + diffuse) + highlight
    return best, hit


@njit(cache=True, parallel=True, error_model="numpy")
def _render(
    poses: ArrayF64,  # [S, H, 3, 4] camera to world, per sample and row
    jitter: ArrayF64,  # [S, 2] offset inside the pixel, in [0, 1)
    lens: ArrayF64,  # [S, 2] point on the lens, metres; zero for a pinhole
    focus: float,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    fisheye: bool,  # without a thin lens
    primitives: NDArray[np.void],
    textures: NDArray[np.float32],
    light: ArrayF64,
    states: ArrayF64,  # [S, H, M, 4] centre and brightness of the last M primitives; M = 0: nothing moves
    image: ArrayF64,
    depth: ArrayF64,
    share: ArrayF64,  # [H, W] share of the samples that see one of these moved, or with another brightness
) -> None:
    """Add the mean of the samples to ``image`` [H, W, 3], ``depth`` [H, W] (camera z) and ``share``."""
    passes, height, width = poses.shape[0], image.shape[0], image.shape[1]
    moving = states.shape[2]
    first = primitives.shape[0] - moving
    for row in prange(height):
        items = primitives.copy() if moving else primitives
        origin, ray, colour, start = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
        scratch = np.zeros((10, 3))
        for column in range(width):
            for number in range(passes):
                pose = poses[number, row]
                for item in range(moving):
                    for axis in range(3):
                        items[first + item]["centre"][axis] = states[number, row, item, axis]
                start[0] = ((column + jitter[number, 0] - cx) / fx) * focus - lens[number, 0]
                start[1] = ((row + jitter[number, 1] - cy) / fy) * focus - lens[number, 1]
                start[2] = focus
                if fisheye:
                    angle = math.sqrt(start[0] * start[0] + start[1] * start[1]) / focus
                    start[2] *= math.cos(angle)
                    for axis in range(2):
                        start[axis] *= math.sin(angle) / max(angle, 1e-12)
                norm = math.sqrt(_dot(start, start))
                for axis in range(3):
                    ray[axis] = _dot(pose[axis], start) / norm
                    on_lens = pose[axis, 0] * lens[number, 0] + pose[axis, 1] * lens[number, 1]
                    origin[axis] = pose[axis, 3] + on_lens
                distance, hit = _trace(origin, ray, 1 / fx, items, textures, light, colour, scratch)
                depth[row, column] += distance * start[2] / norm / passes
                brightness = 1.0
                if hit >= first:
                    brightness = states[number, row, hit - first, 3]
                    changed = brightness != 1.0
                    for axis in range(3):
                        changed |= items[hit]["centre"][axis] != primitives[hit]["centre"][axis]
                    share[row, column] += changed / passes
                for channel in range(3):
                    image[row, column, channel] += brightness * colour[channel] / passes


@dataclass(frozen=True)
class RoomWorld:
    """The room as a `cleargs.synth.optics.World`. Lengths are in metres."""

    room: Room

    def render(self, shutter: Shutter, lens: Lens, aperture: Aperture = PINHOLE) -> ArrayF64:
        """Return the mean [H, W, 3] in linear light of samples at different points inside each pixel."""
        return self._expose(shutter, lens, aperture)[0]

    def film(
        self, movers: Balloon | Household, shutter: Shutter, lens: Lens, aperture: Aperture = PINHOLE
    ) -> tuple[ArrayF64, ArrayF64]:
        """Render the room with what moves in it during the exposure.

        Returns:
            Linear light [H, W, 3], and per pixel [H, W] the share of the exposure that sees movement.
        """
        image, _, share = self._expose(shutter, lens, aperture, movers)
        return image, share

    def depth(self, pose: ArrayF64, lens: Lens) -> ArrayF64:
        """Return the exact camera z at the pixel centres [H, W]."""
        middle = Shutter(pose[None], np.zeros((1, lens.height), np.intp))
        return self._expose(middle, lens, PINHOLE)[1]

    def _expose(
        self, shutter: Shutter, lens: Lens, aperture: Aperture, movers: Balloon | Household | None = None
    ) -> tuple[ArrayF64, ArrayF64, ArrayF64]:
        """Return image, depth, and the share of the samples that see movement; see `_render`."""
        primitives, states = self.room.primitives, np.empty((0, 0, 0, 4))
        if movers is not None:
            times = np.broadcast_to(shutter.times, len(shutter.poses))[shutter.index]
            fixed = primitives[: len(primitives) - movers.resting]
            primitives, states = np.concatenate([fixed, movers.items]), movers.states(times)
        size = lens.height, lens.width
        image, depth, share = np.zeros((*size, 3)), np.zeros(size), np.zeros(size)
        points = np.ascontiguousarray(np.broadcast_to(aperture.points, (shutter.samples, 2)))
        _render(
            shutter.poses[shutter.index], low_discrepancy(shutter.samples), points, aperture.focus,
            lens.fx, lens.fy, lens.cx, lens.cy, lens.fisheye,
            primitives, self.room.textures, self.room.light, states, image, depth, share,
        )  # fmt: skip
        return image, depth, share


def room_setup(frames: int, width: int, height: int, seed: int, moving: int = 0) -> SceneSetup:
    """Return the procedural room of ``seed``, what moves in it, and a walk around its table.

    ``moving`` is a key of `SEVERITIES`; 0: a balloon.
    """
    room = make_room(seed)
    movers: Balloon | Household = Balloon(room, seed)
    if moving:
        movers = household = Household(room, frames / FPS, seed, SEVERITIES[moving])
        room = household.room
    world, course, lens = RoomWorld(room), Orbit(room.focus, frames, seed), phone_lens(width, height)
    return SceneSetup("room", world, course, lens, partial(world.film, movers))
