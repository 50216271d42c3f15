"""Two worlds become one: the similarity that takes one set of cameras to another."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cleargs.capture.cameras import Pose, Similarity
from cleargs.errors import InputError
from cleargs.evaluate.eval_report import Alignment
from cleargs.evaluate.refinement import rotation_between

_ROUNDING = 1e-9  # extent of centres, relative to their coordinates, below which they are one place
_FLAT = 1e-3  # second-largest over largest extent of centres below which the turn about their line is open


def align_cameras(
    source: Sequence[Pose],  # cameras in the world to leave
    target: Sequence[Pose],  # the same ones in the world to enter
) -> tuple[Similarity, Alignment]:
    """The similarity that takes cameras nearest to their like, by place and by direction; how well it fits.

    The centres of a handheld walk lie near a line or a plane, and say little about the turn: half a degree
    may be left, which costs an image decibels. So they only fix the size; then each camera counts as four
    points, its centre and one on each axis, as far away as the centres spread.

    Raises InputError for fewer than three cameras, or centres that lie on one line.
    """
    theirs, ours = (np.stack([pose.centre for pose in poses]) for poses in (source, target))
    scale = umeyama(theirs, ours).scale
    spread = float(np.sqrt(ours.var(axis=0).sum()))
    fit = umeyama(_with_axes(source, theirs, spread * scale), _with_axes(target, ours, spread))
    errors = np.linalg.norm(fit.points(theirs) - ours, axis=1)
    extent = float(np.linalg.norm(ours[:, None] - ours[None], axis=2).max())
    angles = [
        rotation_between(fit.pose(their).rotation, our.rotation)
        for their, our in zip(source, target, strict=True)
    ]
    return fit, Alignment(
        world="umeyama",
        matched=len(source),
        residual=float(np.sqrt((errors**2).mean())) / extent,
        rotation_deg=float(np.mean(angles)),
    )


def _with_axes(
    poses: Sequence[Pose], centres: NDArray[np.float64], length: float
) -> NDArray[np.float64]:  # [4 N, 3]
    axes = np.stack([pose.rotation for pose in poses])  # rows: the camera's axes in the world
    return np.concatenate([centres, (centres[:, None] + length * axes).reshape(-1, 3)])


def umeyama(
    source: NDArray[np.float64],  # [N, 3] centres in the world to leave
    target: NDArray[np.float64],  # [N, 3] the same cameras' centres in the world to enter
) -> Similarity:
    """The similarity of least squares from ``source`` to ``target`` (Umeyama, PAMI 1991), in float64.

    Raises InputError for fewer than three centres, or centres that lie on one line.
    """
    hint = "give at least three references, taken at places that do not lie on one line"
    if len(source) < 3:
        raise InputError(f"{len(source)} matched frames cannot align two worlds", hint=hint)
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    a, b = source - source_mean, target - target_mean
    for places, centred in ((source, a), (target, b)):
        spread = np.linalg.svd(centred, compute_uv=False)
        if spread[0] <= _ROUNDING * np.abs(places).max() or spread[1] <= _FLAT * spread[0]:
            raise InputError(
                "the matched cameras stand at one place or on one line, which fixes no turn about it",
                hint=hint,
            )
    u, stretch, vt = np.linalg.svd(np.einsum("ni,nj->ij", b, a) / len(a))
    mirror = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * mirror) @ vt
    scale = float((stretch * mirror).sum() / ((a * a).sum() / len(a)))
    # The similarity of ingest divides by its scale: x_target = rotation (x_source - origin) / (1 / scale).
    return Similarity(rotation, source_mean - rotation.T @ target_mean / scale, 1.0 / scale)
