"""Picture of RVA's allocation: a map of the cameras, scores over time, and the best and worst frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cleargs.capture.tables import Frame, load_frames
from cleargs.errors import InputError
from cleargs.files import atomic_path
from cleargs.media.contact_sheet import Tile, contact_sheet
from cleargs.media.image import read_rgb
from cleargs.parquet import read_table
from cleargs.report.frames import camera_of
from cleargs.rva.allocation import Role, effective_sample_size
from cleargs.rva.tables import BINS, FRAMES

Row = Mapping[str, Any]
"""A row of rva/frames.parquet."""

FRAMES_PER_ROW = 6
"""Maximum number of frames in a row of images."""

# The palette of Okabe and Ito, which works for any colour vision. Roles differ in shape too.
_ROLES = {
    Role.STRONG: ("#0072B2", "o"),
    Role.GEOMETRIC: ("#009E73", "^"),
    Role.AUXILIARY: ("#E69F00", "s"),
    Role.REACTIVATED: ("#CC79A7", "D"),
    Role.SUPPRESSED: ("#555555", "x"),
}
_TILE = 380  # width of an image, px
_ARROWS = 100  # maximum number; more would hide the trajectory


def plot_allocation(path: Path, rva: Path, ingest: Path, title: str) -> None:
    """Write a PNG from the tables of the stages rva and ingest.

    Args:
        path: The PNG file.
        rva: Folder of the finished stage rva.
        ingest: Folder of the finished stage ingest.
        title: Start of the title of the picture.

    Raises:
        InputError: if no frame has both a pose and scores, or if an image cannot be read.
        StoreError: if a table cannot be read.
    """
    rows = read_table(rva / "frames.parquet", FRAMES).to_pylist()
    covered = read_table(rva / "bins.parquet", BINS)["covered"].to_pylist()
    if all(row["bin"] is None for row in rows):
        raise InputError(
            "no frame has both a pose and scores, so there is no trajectory to draw",
            hint="`cleargs show RUN ingest` and `cleargs show RUN rva` show what is missing",
        )
    frames = {frame.frame_id: frame for frame in load_frames(ingest)}
    pictured = extreme_frames(rows)
    layout: list[Any] = [["map", "scores"], ["map", "weights"], *([name, name] for name in pictured)]
    heights = [3.0, 3.0, *(2.4 for _ in pictured)]
    figure = Figure(figsize=(16.0, sum(heights)), dpi=150, layout="constrained")
    weight = np.array([row["weight"] for row in rows])
    stand_in = sum(row["stand_in"] for row in rows)
    headline = (
        f"{title}: {np.count_nonzero(weight)} of {len(weight)} frames active, effective sample size "
        f"{effective_sample_size(weight):.1f}; {covered.count(False)} of {len(covered)} trajectory bins "
        f"uncovered before compensation; "
        f"{f'no reliable frame, {stand_in} frames replace them; ' if stand_in else ''}"
        f"evaluator: {rows[0]['evaluator']}"
    )
    figure.suptitle(fill(headline, 140), fontsize=12, parse_math=False)  # names may contain dollar signs
    panels = figure.subplot_mosaic(layout, width_ratios=(1.0, 1.6), height_ratios=heights)
    _draw_map(panels["map"], [row for row in rows if frames[row["frame_id"]].registered], frames)
    _draw_along(panels["scores"], panels["weights"], rows, frames, covered)
    for name, shown in pictured.items():
        tiles = []
        for row in shown:
            geometry = "no pose" if row["G"] is None else f"G {row['G']:.2f} weight {row['weight']:.2f}"
            label = f"{row['frame_id']} {row['role']} R {row['R']:.2f} B {row['B']:.2f} {geometry}"
            image = read_rgb(ingest / frames[row["frame_id"]].image)
            tiles.append(Tile(image, label, marked=bool(row["weight"])))
        sheet = contact_sheet([tiles], tile_width=_TILE)
        panels[name].imshow(sheet)
        # The same scale in every row, even in a row of few frames.
        panels[name].set(title=name, xlim=(0, sheet.shape[1] * FRAMES_PER_ROW / len(tiles)))
        panels[name].axis("off")
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png")


def extreme_frames(rows: Sequence[Row], most: int = FRAMES_PER_ROW) -> dict[str, list[Row]]:
    """Select the best and worst frames by R - B, and some reactivated frames.

    The most extreme frames come first. They are at least a twentieth of the capture apart, because neighbours
    show the same view. The reactivated frames are spread evenly along the trajectory.

    Args:
        rows: The rows of all frames.
        most: Maximum number of frames per kind.

    Returns:
        Title of the kind -> rows of its frames.
    """
    scored = [k for k, row in enumerate(rows) if row["R"] is not None]
    ranked = sorted(scored, key=lambda k: rows[k]["B"] - rows[k]["R"])
    half = (len(ranked) + 1) // 2
    reactivated = [k for k, row in enumerate(rows) if row["role"] == Role.REACTIVATED]
    spread = np.linspace(0, len(reactivated) - 1, min(most, len(reactivated))).round().astype(int)
    found = {"best by R - B": ranked[:half], "worst by R - B": ranked[half:][::-1]}
    for title, candidates in found.items():
        chosen: list[int] = []
        for k in candidates:
            if len(chosen) < most and all(abs(k - other) >= len(rows) // 20 for other in chosen):
                chosen.append(k)
        found[title] = chosen
    found[f"reactivated: {len(spread)} of {len(reactivated)}"] = [reactivated[index] for index in spread]
    return {title: [rows[k] for k in chosen] for title, chosen in found.items() if chosen}


def _draw_map(panel: Axes, rows: Sequence[Row], frames: Mapping[int, Frame]) -> None:
    """Draw the cameras from above, with x to the right and z upwards."""
    cameras = [camera_of(frames[row["frame_id"]]) for row in rows]
    x, _, z = np.array([camera.centre for camera in cameras]).T
    panel.plot(x, z, color="0.75", zorder=1)
    every = -(-len(rows) // _ARROWS)
    look = np.array([camera.world_to_camera[2, :3] for camera in cameras])[::every]
    panel.quiver(x[::every], z[::every], look[:, 0], look[:, 2], width=0.0025, color="0.6")
    _mark_frames(panel, x, z, rows)
    for k, name in ((0, "start"), (-1, "end")):
        panel.annotate(f"{rows[k]['frame_id']} ({name})", (x[k], z[k]), (7, -4), textcoords="offset points")
    panel.set_aspect("equal", adjustable="datalim")
    panel.margins(0.12)
    panel.set(title="from above; arrow: view, size: weight", xlabel="x; z upwards (normalised coordinates)")


def _draw_along(
    scores: Axes, weights: Axes, rows: Sequence[Row], frames: Mapping[int, Frame], covered: Sequence[bool]
) -> None:
    """Draw scores and weights over time in seconds, or over frames without times. Shade uncovered bins."""
    times = [frames[row["frame_id"]].time_s for row in rows]
    x = np.array([row["frame_id"] for row in rows] if None in times else times, np.float64)
    for name, style in (("R, reliability", "k.-"), ("B, degradation risk", "r.--"), ("G, geometry", "b.:")):
        scores.plot(x, np.array([row[name[0]] for row in rows], np.float64), style, linewidth=1.0, label=name)
    _mark_frames(weights, x, np.array([row["weight"] for row in rows]), rows)
    half = 0.5 * (x[-1] - x[0]) / max(len(x) - 1, 1)
    for panel in (scores, weights):
        for number in np.flatnonzero(np.logical_not(covered)):
            inside = x[[row["bin"] == number for row in rows]]
            if len(inside):
                panel.axvspan(inside[0] - half, inside[-1] + half, color="#F3CFE2", linewidth=0.0, zorder=0)
        panel.grid(axis="y", alpha=0.25)
        panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=9)
    scores.set(ylim=(-0.03, 1.03), title="shaded: bins without an active frame before compensation")
    weights.set(ylim=(-0.08, 1.08), ylabel="weight", xlabel="frame" if None in times else "time (s)")


def _mark_frames(panel: Axes, x: NDArray[Any], y: NDArray[Any], rows: Sequence[Row]) -> None:
    """Draw a mark per frame with the colour and shape of its role and a size that grows with its weight."""
    for role, (colour, shape) in _ROLES.items():
        members = [k for k, row in enumerate(rows) if row["role"] == role]
        sizes = [14.0 + 50.0 * rows[k]["weight"] for k in members]
        if members:
            label = f"{role} ({len(members)})"
            panel.scatter(x[members], y[members], s=sizes, c=colour, marker=shape, label=label, zorder=4)
