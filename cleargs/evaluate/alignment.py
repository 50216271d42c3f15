"""Alignment of two worlds by their cameras, and checks of their unit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cleargs.capture.cameras import Pose, Similarity
from cleargs.errors import InputError
from cleargs.evaluate.eval_report import Alignment
from cleargs.evaluate.refinement import rotation_between
from cleargs.progress import Reporter
from cleargs.types import ArrayF64

LARGE_RESIDUAL = 0.02
"""Residual of a fit of two worlds, as a share of the trajectory's extent, above which there is a warning."""

MAX_RESIDUAL = 0.05
"""Residual above which there is an error: each view would be rendered far from its reference."""

MAX_OUTSIDE, MIN_SPREAD = 3.0, 0.01
"""Distance of the references, in reaches of the scene, and spread of them, in that of the frames, from which
the units of both differ."""

_ROUNDING = 1e-9  # extent of centres, relative to their coordinates, below which they count as one place
_FLAT = 1e-3  # second-largest over largest extent of centres below which they count as one line


def report_fit(alignment: Alignment, folder: Path, reporter: Reporter) -> None:
    assert alignment.residual is not None  # fitted
    text = (
        f"worlds aligned by {alignment.matched} cameras of {folder}: residual {alignment.residual:.2%} "
        f"of the trajectory's extent, orientations {alignment.rotation_deg:.2f} degrees apart"
    )
    hint = "give --align DIR with the poses of the run's own frames: equal stems may be other frames here"
    if alignment.residual > MAX_RESIDUAL:
        raise InputError(f"{text}: too large for a comparison", hint=hint)
    if alignment.residual > LARGE_RESIDUAL:
        reporter.warn(f"{text}: large; {hint}")
    else:
        reporter.info(text)


def require_one_unit(theirs: Sequence[Pose], ours: Sequence[Pose], points: ArrayF64) -> None:
    """Raise InputError if the references are far outside the scene, or all at one place of it.

    ``points`` [P, 3] are the scene's, in the world of both.
    """
    if not ours:
        return
    away, own = (np.stack([pose.centre for pose in poses]) for poses in (theirs, ours))
    middle = own.mean(axis=0)
    scene = np.concatenate([own, points])
    reach = float(np.quantile(np.linalg.norm(scene - middle, axis=1), 0.99))
    distance = float(np.median(np.linalg.norm(away - middle, axis=1)))
    spreads = [float(np.linalg.norm(centres.std(axis=0))) for centres in (away, own)]
    fault = ""
    if distance > MAX_OUTSIDE * reach:
        times = distance / max(reach, 1e-12)
        fault = f"the references are {times:.3g} times as far away as the scene reaches"
    elif len(away) >= 3 and spreads[0] < spreads[1] * MIN_SPREAD:
        times = spreads[1] / max(spreads[0], 1e-12)
        fault = f"the references are {times:.3g} times as close together as the frames"
    if fault:
        hint = "give their poses in the world and the units of the run's input (metres against millimetres?)"
        raise InputError(fault, hint=hint)


def align_cameras(source: Sequence[Pose], target: Sequence[Pose]) -> tuple[Similarity, Alignment]:
    """Return the similarity that maps cameras best, by position and direction, and its residuals.

    ``source`` and ``target`` are the same cameras, in the world to map from and in the world to map to.

    The centres of a handheld walk are near a line or a plane, so they fix the rotation poorly: an error of
    half a degree may remain, which costs an image decibels. Therefore the centres give only a first scale.
    Then each camera counts as four points: its centre, and one on each axis at the distance by which the
    centres spread. Raises InputError for fewer than three cameras, or for centres on one line.
    """
    theirs, ours = (np.stack([pose.centre for pose in poses]) for poses in (source, target))
    scale = umeyama(theirs, ours).scale
    spread = float(np.sqrt(ours.var(axis=0).sum()))
    fit = umeyama(_with_axes(source, theirs, spread * scale), _with_axes(target, ours, spread))
    errors = np.linalg.norm(fit.points(theirs) - ours, axis=1)
    extent = float(np.linalg.norm(ours[:, None] - ours[None], axis=2).max())
    pairs = zip(source, target, strict=True)
    angles = [rotation_between(fit.pose(their).rotation, our.rotation) for their, our in pairs]
    return fit, Alignment(
        world="umeyama",
        matched=len(source),
        residual=float(np.sqrt((errors**2).mean())) / extent,
        rotation_deg=float(np.mean(angles)),
    )


def _with_axes(poses: Sequence[Pose], centres: ArrayF64, length: float) -> ArrayF64:  # [4 N, 3]
    axes = np.stack([pose.rotation for pose in poses])  # rows: the camera's axes in the world
    return np.concatenate([centres, (centres[:, None] + length * axes).reshape(-1, 3)])


def umeyama(source: ArrayF64, target: ArrayF64) -> Similarity:
    """Return the least-squares similarity from ``source`` to ``target`` (Umeyama, PAMI 1991), in float64.

    Both are the centres [N, 3] of the same cameras. Raises InputError for fewer than three centres, or for
    centres on one line.
    """
    hint = "give at least three references, taken at places that are not on one line"
    if len(source) < 3:
        raise InputError(f"{len(source)} matched frames cannot align two worlds", hint=hint)
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    a, b = source - source_mean, target - target_mean
    for places, centred in ((source, a), (target, b)):
        spread = np.linalg.svd(centred, compute_uv=False)
        if spread[0] <= _ROUNDING * np.abs(places).max() or spread[1] <= _FLAT * spread[0]:
            what = "the matched cameras are at one place or on one line, which fixes no turn about it"
            raise InputError(what, hint=hint)
    u, stretch, vt = np.linalg.svd(np.einsum("ni,nj->ij", b, a) / len(a))
    mirror = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * mirror) @ vt
    scale = float((stretch * mirror).sum() / ((a * a).sum() / len(a)))
    # `Similarity` divides by its scale: x_target = rotation (x_source - origin) / (1 / scale).
    return Similarity(rotation, source_mean - rotation.T @ target_mean / scale, 1.0 / scale)
