"""Plain geometry of a report's drawings: SVG paths of curves, and cameras seen from above."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from matplotlib.ticker import MaxNLocator

from cleargs.parquet import read_table
from cleargs.report.frames import FrameRow, camera_of
from cleargs.splat.tables import TRAIN

WIDTH, HEIGHT = 640, 220
"""Of a curve's drawing area, in units of its SVG."""

_POINTS = 120  # of a curve
_LOW, _HIGH = np.array([222.0, 135.0, 38.0]), np.array([22.0, 146.0, 138.0])  # amber, teal


def training_curves(run: Path, stages: Sequence[str]) -> list[dict[str, Any]]:
    """Loss and PSNR on real frames, and Gaussians, over the steps of these stages. Raises StoreError.

    Places (of ticks, and of the parts where each training starts) are in `WIDTH` x `HEIGHT`.
    """
    paths = {stage: run / stage / "train.parquet" for stage in stages}
    tables = {stage: read_table(path, TRAIN) for stage, path in paths.items() if path.is_file()}
    tables = {stage: table for stage, table in tables.items() if table.num_rows}
    if not tables:
        return []
    steps = pa.concat_tables(tables.values())
    real = np.array(steps["kind"].to_pylist()) == "real"
    starts = np.cumsum([0, *(table.num_rows for table in tables.values())])
    parts = [(start / len(real) * WIDTH, stage) for start, stage in zip(starts, tables, strict=False)]

    def curve(title: str, unit: str, name: str, digits: int, *, only_real: bool) -> dict[str, Any]:
        values = steps[name].to_numpy().astype(np.float64)
        known = np.flatnonzero(real & np.isfinite(values)) if only_real else np.arange(len(values))
        # Medians of equal stretches: a step shows one view, and views differ more than steps do.
        stretches = np.array_split(known, min(_POINTS, max(1, len(known) // 6)))
        x = np.array([part.mean() for part in stretches]) / max(len(values) - 1, 1) * WIDTH
        y = np.array([np.median(values[part]) for part in stretches])
        ticks = MaxNLocator(5, steps=(1, 2, 2.5, 5, 10)).tick_values(float(y.min()), float(y.max()))
        down = np.interp(y, (ticks[0], ticks[-1]), (HEIGHT, 0.0))
        return {
            "title": title,
            "unit": unit,
            "path": "M" + " L".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, down, strict=True)),
            "ticks": list(zip(np.linspace(HEIGHT, 0.0, len(ticks)), (f"{t:,g}" for t in ticks), strict=True)),
            "parts": parts,
            "steps": len(values),
            "first": f"{y[0]:,.{digits}f}",
            "last": f"{y[-1]:,.{digits}f}",
        }

    return [
        curve("PSNR of the frames trained on", "dB", "psnr", 1, only_real=True),
        curve("Loss", "", "loss", 3, only_real=True),
        curve("Gaussians", "", "n_gaussians", 0, only_real=False),
    ]


def weight_colour(weight: float) -> str:
    """Amber (barely used) to teal (fully), which people with any colour vision can tell apart."""
    red, green, blue = np.rint(_LOW + (_HIGH - _LOW) * min(max(weight, 0.0), 1.0)).astype(int)
    return f"#{red:02x}{green:02x}{blue:02x}"


def plan_of(rows: Sequence[FrameRow]) -> dict[str, Any] | None:
    """The cameras of the placed frames from above (x to the right, z up), in units of the SVG; None without
    any. The tip of a mark ends the line that shows where it looks.
    """
    placed = [row for row in rows if row.frame.registered]
    if not placed:
        return None
    cameras = [camera_of(row.frame) for row in placed]
    centres = np.array([camera.centre[[0, 2]] for camera in cameras]) * [1.0, -1.0]
    looks = np.array([camera.world_to_camera[2, [0, 2]] for camera in cameras]) * [1.0, -1.0]
    looks /= np.maximum(np.linalg.norm(looks, axis=1, keepdims=True), 1e-9)
    low, high = centres.min(axis=0), centres.max(axis=0)
    scale = 520.0 / max(float((high - low).max()), 1e-6)
    size = (high - low) * scale
    height = float(np.clip(size[1], 160.0, 420.0))
    at = (centres - (low + high) / 2.0) * min(scale, height / max(float(high[1] - low[1]), 1e-6))
    at += np.array([size[0], height]) / 2.0 + 60.0
    marks = [
        {
            "frame_id": row.frame.frame_id,
            "x": round(float(x), 1),
            "y": round(float(y), 1),
            "radius": 5.0 + 3.0 * (row.weight or 0.0),
            "colour": weight_colour(row.weight or 0.0),
            "tip": (round(float(x + 26 * dx), 1), round(float(y + 26 * dy), 1)),
            "active": bool(row.weight),
        }
        for row, (x, y), (dx, dy) in zip(placed, at, looks, strict=True)
    ]
    path = "M" + " L".join(f"{mark['x']},{mark['y']}" for mark in marks)
    return {"width": float(size[0]) + 120.0, "height": height + 120.0, "path": path, "marks": marks}


def fitted_bars(rows: Sequence[FrameRow]) -> list[dict[str, Any]]:
    """The figures of each frame's exposure, as far as they are known: frame id and value of each bar."""
    bars = []
    for title, unit, found in (
        ("Motion blur", "px", [row.motion("blur_px") for row in rows]),
        ("Rolling shutter", "px", [row.motion("skew_px") for row in rows]),
        ("Defocus", "px", [row.formation.get("defocus_px") for row in rows]),
        ("Exposure", "stops", [row.gain_ev for row in rows]),
    ):
        numbered = zip(rows, found, strict=True)
        known = [(row.frame.frame_id, float(value)) for row, value in numbered if value is not None]
        if not known:
            continue
        values = [value for _, value in known]
        summary = f"median {np.median(values):.1f} {unit}, at most {max(values):.1f} {unit}"
        if unit == "stops":
            summary = f"from {min(values):+.2f} to {max(values):+.2f} {unit}"
        span = {"low": min(0.0, *values), "high": max(0.0, *values) or 1.0}
        bars.append({"title": title, "unit": unit, "known": known, "summary": summary, **span})
    return bars
