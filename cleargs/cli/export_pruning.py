"""``cleargs export --prune`` and ``--crop``: which Gaussians are left out, and what that costs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from operator import lt
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cleargs.capture.tables import load_frames
from cleargs.cli.progress_bars import make_reporter
from cleargs.errors import InputError
from cleargs.formation.exposure import read_exposure
from cleargs.formation.frames import real_views
from cleargs.formation.observed import evaluate_views
from cleargs.formation.table import read_formation
from cleargs.parquet import read_table
from cleargs.rva.tables import FRAMES
from cleargs.splat.backend import rasteriser_for
from cleargs.splat.camera import Camera
from cleargs.splat.constants import SH_C0
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.scene import Scene
from cleargs.splat.views import TrainingView

PRUNE_HINT = "give opacity:O with O from 0 to 1, or contribution:P with P pixels"
CROP_HINT = "give box:X,Y,Z,X,Y,Z with the lower corner first, or percentile:P with P above 0 and up to 100"


def parse_prune(rules: Sequence[str]) -> dict[str, float]:
    """Least ``opacity`` and least ``contribution``, of those that are given. Raises InputError."""
    thresholds: dict[str, float] = {}
    for rule in rules:
        kind, values = _parsed(rule, opacity=1, contribution=1)
        if not values or kind in thresholds or values[0] < 0:
            raise InputError(f"--prune {rule} cannot be understood", hint=PRUNE_HINT)
        thresholds[kind] = values[0]
    return thresholds


def parse_crop(rule: str | None) -> tuple[float, ...] | None:
    """The corners of a box (six numbers), or a percentage (one). Raises InputError."""
    if rule is None:
        return None
    kind, values = _parsed(rule, box=6, percentile=1)
    low, high = values[:3], values[3:]
    if not values or not (all(map(lt, low, high)) if kind == "box" else 0.0 < values[0] <= 100.0):
        raise InputError(f"--crop {rule} cannot be understood", hint=CROP_HINT)
    return values


def _parsed(rule: str, **counts: int) -> tuple[str, tuple[float, ...]]:
    """KIND:NUMBER,NUMBER... in two parts; no numbers where they are not as many as ``counts`` says."""
    kind, _, numbers = rule.partition(":")
    try:
        values = tuple(float(number) for number in numbers.split(","))
    except ValueError:
        values = ()
    return kind, values if len(values) == counts.get(kind) and np.isfinite(values).all() else ()


def pruned(scene: Scene, thresholds: Mapping[str, float], run: Path, stage: str) -> tuple[Scene, str]:
    """``scene`` without the Gaussians below a threshold, and a line that tells what it cost.

    The PSNR is that of the training frames, as their cameras saw the scene.
    """
    ingest, folder = run / "ingest", run / stage
    allocation = read_table(run / "rva" / "frames.parquet", FRAMES).to_pylist()
    views = real_views(load_frames(ingest), {row["frame_id"]: row["weight"] for row in allocation}, ingest)
    gaussians, reporter = scene.gaussians, make_reporter()
    keep = torch.sigmoid(gaussians.logit_opacities) >= thresholds.get("opacity", 0.0)
    if "contribution" in thresholds:
        with reporter.task("contributions", len(views)) as task:
            most = contributions(scene, (view.camera for view in views), task.advance)
        keep &= most >= thresholds["contribution"]
    smaller = replace(scene, gaussians=gaussians.select(keep))
    with reporter.task("PSNR", 2 * len(views)) as task:
        before, after = (_psnr(which, views, folder, task.advance) for which in (scene, smaller))
    return smaller, (
        f"pruned {gaussians.num - smaller.gaussians.num} of {gaussians.num} Gaussians; PSNR of {len(views)} "
        f"training frames {before:.2f} -> {after:.2f} dB"
    )


def _psnr(scene: Scene, views: Sequence[TrainingView], folder: Path, seen: Callable[[], None]) -> float:
    """Mean over ``views``, through the exposure and the motion that the stage in ``folder`` found, dB."""
    exposure = read_exposure(folder / "exposure.parquet")
    formations, _ = read_formation(folder / "formation.parquet")
    engine, values = rasteriser_for(), []
    for view in views:
        (fit,) = evaluate_views(scene, [view], exposure, formations, engine=engine)
        values.append(fit.psnr)
        seen()
    return fmean(values)


def cropped(scene: Scene, region: tuple[float, ...]) -> tuple[Scene, str]:
    """``scene`` inside the ``region`` of `parse_crop`, and a line that tells what is left."""
    means = scene.gaussians.means
    if not len(means):
        raise InputError("no Gaussian is left to crop", hint="prune less")
    if len(region) == 1:
        low, high = central_box(means, region[0])
    else:
        low, high = np.array(region[:3]), np.array(region[3:])
    smaller = scene.gaussians.select(inside(means, low, high))
    box = ",".join(f"{value:.4g}" for value in (*low, *high))
    return replace(scene, gaussians=smaller), (
        f"cropped to the box {box}: {means.shape[0] - smaller.num} of {means.shape[0]} Gaussians lie outside"
    )


def contributions(scene: Scene, cameras: Iterable[Camera], seen: Callable[[], None]) -> Tensor:  # [N]
    """How much of a picture each Gaussian makes up: its blending weights (opacity times the transmittance in
    front of it), summed over the pixels of the camera where that sum is largest. Unit: pixels.

    A pixel is the sum of weight times colour, so the gradient of a picture's sum by a Gaussian's colour is
    the sum of its weights. The colours are set to grey, since the clamp of a negative one would hide it.
    ``seen`` is called after each camera.
    """
    gaussians = scene.gaussians.detach()
    grey = Gaussians(**{**gaussians.tensors(), "sh": torch.zeros_like(gaussians.sh[:, :1])})
    engine = rasteriser_for(gaussians.device)
    most = torch.zeros(gaussians.num, device=gaussians.device)
    for camera in cameras:
        image = engine.forward(grey, camera, antialias=scene.antialias).image
        of_red = torch.zeros_like(image)
        of_red[..., 0] = 1.0 / SH_C0
        torch.maximum(most, engine.backward(of_red).sh[:, 0, 0], out=most)
        seen()
    return most


def inside(means: Tensor, low: NDArray[np.float64], high: NDArray[np.float64]) -> Tensor:  # [N] bool
    """Which ``means`` [N, 3] lie in the box from ``low`` [3] to ``high`` [3], its faces included."""
    where = means.double()
    return ((where >= torch.from_numpy(low)) & (where <= torch.from_numpy(high))).all(dim=1)


def central_box(means: Tensor, percent: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The box that holds the middle ``percent`` of the ``means`` [N, 3] along each axis by itself."""
    margin = (100.0 - percent) / 2
    low, high = np.percentile(means.double().numpy(), [margin, 100.0 - margin], axis=0)
    return low, high
