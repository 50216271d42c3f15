"""Lenses of a reconstruction in words and in figures: focal lengths, and the frames that have them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby, pairwise
from typing import Any

import numpy as np

from cleargs.capture.cameras import MAX_ASPECT, has_usual_focal
from cleargs.capture.config import SfmConfig
from cleargs.capture.model import SparseModel
from cleargs.capture.prepare import WorkFrame
from cleargs.progress import Reporter

JUMP, MAX_NAMED = 0.05, 5
"""Change of the logarithm of the focal length from one frame to the next that is named, and most names."""


def camera_rows(model: SparseModel, frames: Sequence[WorkFrame]) -> list[dict[str, Any]]:
    """Return lens, mean focal length (px), number and names of the frames of each camera.

    If each frame has its own, they are one row, with the median and the range of the focal lengths.
    """
    used = _frames_of_cameras(model, frames)
    lenses = {key: model.cameras[key] for key in used}
    focal = {key: round(sum(camera.focal) / 2, 3) for key, camera in lenses.items()}
    if len(used) == len(model.images) > 1 and len({camera.model for camera in lenses.values()}) == 1:
        median = round(float(np.median(list(focal.values()))), 3)
        row = {"lens": next(iter(lenses.values())).model, "focal_px": median, "frames": len(used)}
        ends = [choice(used, key=lambda key: focal[key]) for choice in (min, max)]
        if focal[ends[0]] == focal[ends[1]]:
            return [row]
        range_px = [focal[key] for key in ends]
        return [{**row, "focal_range_px": range_px, "focal_range_in": [used[key][0] for key in ends]}]
    rows = [
        {"lens": lenses[key].model, "focal_px": focal[key], "frames": len(names)}
        for key, names in sorted(used.items())
    ]
    if len(rows) > 1:
        for row, text in zip(rows, _stretches(used, frames), strict=True):
            row["named"] = text
    return rows


def _frames_of_cameras(model: SparseModel, frames: Sequence[WorkFrame]) -> dict[int, list[str]]:
    """Return camera -> the names of its frames in the input, in order."""
    camera_of = {image.name: image.camera_id for image in model.images.values()}
    found: dict[int, list[str]] = {}
    for frame in frames:
        if frame.image in camera_of:
            found.setdefault(camera_of[frame.image], []).append(frame.source.name)
    return found


def _stretches(used: Mapping[int, Sequence[str]], frames: Sequence[WorkFrame]) -> list[str]:
    """Return the names of the frames of each camera, in order of the cameras: "a to c, f"."""
    owner = {name: key for key, names in used.items() for name in names}
    runs: dict[int, list[str]] = {key: [] for key in sorted(used)}
    for key, group in groupby(filter(owner.__contains__, (f.source.name for f in frames)), owner.__getitem__):
        first, *others = group
        runs[key].append(f"{first} to {others[-1]}" if others else first)
    return [", ".join(run[:MAX_NAMED] + ["..."] * (len(run) > MAX_NAMED)) for run in runs.values()]


def report_lens(
    model: SparseModel, frames: Sequence[WorkFrame], config: SfmConfig, before: int, reporter: Reporter
) -> None:
    """Say which frames a focal length that changes is shortest and longest in, and warn of a strange lens.

    ``before`` is the number of cameras before the images were asked.
    """
    used = _frames_of_cameras(model, frames)
    lenses = [model.cameras[key] for key in sorted(used)]
    ratios = [max(lens.focal) / min(lens.focal) for lens in lenses]
    shares = [sum(lens.focal) / 2 / max(lens.width, lens.height) for lens in lenses]
    believed = all(has_usual_focal(lens.model, share) for lens, share in zip(lenses, shares, strict=True))
    usual = config.focal is not None or believed
    if max(ratios) > MAX_ASPECT or not usual:
        lens = lenses[int(np.argmax(ratios))] if max(ratios) > MAX_ASPECT else lenses[0]
        fx, fy = lens.focal
        reporter.warn(
            f"almost no lens is like this one: focal lengths {fx:.0f} and {fy:.0f} px for images of "
            f"{lens.width}x{lens.height}; state the lens (ingest.focal, ingest.camera_model)"
        )
    if not config.shared_camera or len(lenses) <= before:
        return
    focal = {names[0]: sum(model.cameras[key].focal) / 2 for key, names in used.items()}
    if len(lenses) < len(model.images):
        found = [
            f"{sum(lens.focal) / 2:.0f} px in {text}"
            for lens, text in zip(lenses, _stretches(used, frames), strict=True)
        ]
        others = f" and {len(found) - MAX_NAMED} others" if len(found) > MAX_NAMED else ""
        reporter.warn(
            f"the focal length changes: {'; '.join(found[:MAX_NAMED])}{others}. Frames whose focal lengths "
            "are alike share a camera"
        )
    elif min(shares) < max(shares):
        short, long = (choice(focal, key=lambda name: focal[name]) for choice in (min, max))
        jumps = [two for one, two in pairwise(focal) if abs(np.log(focal[two] / focal[one])) > JUMP]
        at = f", with jumps at {', '.join(jumps[:MAX_NAMED])}" if jumps else ""
        reporter.warn(
            f"the focal length changes from frame to frame: {focal[short]:.0f} px in {short}, "
            f"{focal[long]:.0f} px in {long}{at}; each frame has its own camera"
        )
