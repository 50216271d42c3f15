"""Leave out Gaussians of a scene, and measure the loss of PSNR: ``cleargs export --prune`` and ``--crop``."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from operator import lt
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cleargs.capture.tables import load_frames
from cleargs.errors import InputError
from cleargs.packed import read_pack
from cleargs.parquet import read_table
from cleargs.progress import Reporter
from cleargs.rva.tables import FRAMES
from cleargs.scene.dust import contributions
from cleargs.scene.folder import SceneFolder
from cleargs.scene.measure import evaluate_views
from cleargs.scene.views import real_views
from cleargs.splat.backend import mean_psnr, rasteriser_for
from cleargs.splat.scene import Scene
from cleargs.splat.views import TrainingView

DROP_HINT = "give sphere:X,Y,Z,R with a radius R above 0"
PRUNE_HINT = "give opacity:O with O from 0 to 1, or contribution:P with P in pixels"
CROP_HINT = "give box:X,Y,Z,X,Y,Z with the lower corner first, or percentile:P with P above 0 and up to 100"


def parse_prune(rules: Sequence[str]) -> dict[str, float]:
    """Return the minimum ``opacity`` (0 to 1) and ``contribution`` (pixels), if given. Raises InputError."""
    thresholds: dict[str, float] = {}
    for rule in rules:
        kind, values = _parsed(rule, opacity=1, contribution=1)
        if not values or kind in thresholds or values[0] < 0:
            raise InputError(f"--prune {rule} is not valid", hint=PRUNE_HINT)
        thresholds[kind] = values[0]
    return thresholds


def parse_crop(rule: str | None) -> tuple[float, ...] | None:
    """Return the lower and the upper corner of a box (six numbers), or a percentage (one number).

    Raises InputError.
    """
    if rule is None:
        return None
    kind, values = _parsed(rule, box=6, percentile=1)
    low, high = values[:3], values[3:]
    if not values or not (all(map(lt, low, high)) if kind == "box" else 0.0 < values[0] <= 100.0):
        raise InputError(f"--crop {rule} is not valid", hint=CROP_HINT)
    return values


def parse_drop(rules: Sequence[str]) -> list[tuple[float, ...]]:
    """Return centre and radius (four numbers) of each sphere. Raises InputError."""
    spheres = []
    for rule in rules:
        _, values = _parsed(rule, sphere=4)
        if not values or values[3] <= 0.0:
            raise InputError(f"--drop {rule} is not valid", hint=DROP_HINT)
        spheres.append(values)
    return spheres


def drop_spheres(scene: Scene, spheres: Iterable[tuple[float, ...]]) -> tuple[Scene, list[str]]:
    """Return the scene without the Gaussians whose centres are in a sphere of `parse_drop`, and messages."""
    messages = []
    for *centre, radius in spheres:
        away = torch.linalg.vector_norm(scene.gaussians.means - torch.tensor(centre), dim=1) > radius
        if away.all() or not away.any():
            what = "no Gaussian is" if away.all() else "all Gaussians are"
            raise InputError(f"{what} in the sphere {_numbers((*centre, radius))}", hint=extent_text(scene))
        messages.append(f"dropped {int((~away).sum())} Gaussians in the sphere {_numbers((*centre, radius))}")
        scene = replace(scene, gaussians=scene.gaussians.select(away))
    return scene, messages


def extent_text(scene: Scene) -> str:
    """Return the box of all centres, and of their 1 to 99 % along each axis, in the form of ``--crop``."""
    means = scene.gaussians.means
    if not len(means):
        return "the scene is empty"
    whole, most = (means.amin(0).tolist() + means.amax(0).tolist(), np.concatenate(central_box(means, 98.0)))
    return f"the scene is in box:{_numbers(whole)}, its 1 to 99 % in box:{_numbers(most)}"


def _numbers(values: Iterable[float]) -> str:
    return ",".join(f"{value:.4g}" for value in values)


def _parsed(rule: str, **counts: int) -> tuple[str, tuple[float, ...]]:
    """Split KIND:NUMBER,NUMBER... Return no numbers if their count is not that of KIND in ``counts``."""
    kind, _, numbers = rule.partition(":")
    try:
        values = tuple(float(number) for number in numbers.split(","))
    except ValueError:
        values = ()
    return kind, values if len(values) == counts.get(kind) and np.isfinite(values).all() else ()


def prune_scene(
    scene: Scene, thresholds: Mapping[str, float], run: Path, stage: str, reporter: Reporter
) -> tuple[Scene, str]:
    """Remove the Gaussians below one of the ``thresholds`` of `parse_prune`.

    Returns the smaller scene, and a message with the number of removed Gaussians and the PSNR before and
    after, measured on the training frames with the image formation of ``stage`` (not in a packed run).
    """
    ingest, folder = run / "ingest", run / stage
    allocation = read_table(run / "rva" / "frames.parquet", FRAMES).to_pylist()
    views = real_views(load_frames(ingest), {row["frame_id"]: row["weight"] for row in allocation}, ingest)
    gaussians = scene.gaussians
    keep = torch.sigmoid(gaussians.logit_opacities) >= thresholds.get("opacity", 0.0)
    if "contribution" in thresholds:
        with reporter.task("contributions", len(views)) as task:
            largest = contributions(scene, (view.camera for view in views), task.advance)
        keep &= largest >= thresholds["contribution"]
    smaller = replace(scene, gaussians=gaussians.select(keep))
    removed = f"pruned {gaussians.num - smaller.gaussians.num} of {gaussians.num} Gaussians"
    if read_pack(run) is not None:
        return smaller, f"{removed}; a packed run has no images to measure the PSNR"
    with reporter.task("PSNR", 2 * len(views)) as task:
        before, after = (training_psnr(which, views, folder, task.advance) for which in (scene, smaller))
    return smaller, (f"{removed}; PSNR of {len(views)} training frames {before:.2f} -> {after:.2f} dB")


def training_psnr(
    scene: Scene, views: Sequence[TrainingView], folder: Path, advance: Callable[[], None] = lambda: None
) -> float:
    """Return the mean PSNR of ``views`` in dB, with the image formation of the stage in ``folder``."""
    files = SceneFolder(folder)
    exposure, (formations, _) = files.exposure(), files.formations()
    engine, values = rasteriser_for(), []
    for view in views:
        (fit,) = evaluate_views(scene, [view], exposure, formations, engine=engine)
        values.append(fit.psnr)
        advance()
    mean = mean_psnr(values)
    return math.inf if mean is None else mean


def crop_scene(scene: Scene, region: tuple[float, ...]) -> tuple[Scene, str]:
    """Return the scene inside the ``region`` of `parse_crop`, and a message with the number of Gaussians."""
    means = scene.gaussians.means
    if not len(means):
        raise InputError("no Gaussian is left to crop", hint="prune less")
    if len(region) == 1:
        low, high = central_box(means, region[0])
    else:
        low, high = np.array(region[:3]), np.array(region[3:])
    smaller = scene.gaussians.select(inside(means, low, high))
    box = _numbers((*low, *high))
    if not smaller.num:
        raise InputError(f"no Gaussian is left in the box {box}", hint=extent_text(scene))
    return replace(scene, gaussians=smaller), (
        f"cropped to the box {box}: {means.shape[0] - smaller.num} of {means.shape[0]} Gaussians are outside"
    )


def inside(means: Tensor, low: NDArray[np.float64], high: NDArray[np.float64]) -> Tensor:  # [N] bool
    """Return the mask of the ``means`` [N, 3] in the box from ``low`` [3] to ``high`` [3], faces included."""
    points = means.double()
    return ((points >= torch.from_numpy(low)) & (points <= torch.from_numpy(high))).all(dim=1)


def central_box(means: Tensor, percent: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the corners [3] of the box with the middle ``percent`` of ``means`` [N, 3] along each axis."""
    margin = (100.0 - percent) / 2
    low, high = np.percentile(means.double().numpy(), [margin, 100.0 - margin], axis=0)
    return low, high
