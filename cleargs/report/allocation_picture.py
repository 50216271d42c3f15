"""How RVA judged a capture, as a picture: the trajectory from above and along time, and telling frames."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from cleargs.capture.tables import load_frames
from cleargs.errors import InputError
from cleargs.files import atomic_path
from cleargs.media.image import read_rgb
from cleargs.parquet import read_table
from cleargs.rva.allocation import Role, Roles, effective_sample_size
from cleargs.rva.arrays import Bools, Floats, Ints
from cleargs.rva.assessment import poses_from
from cleargs.rva.geometry import camera_centres, view_directions
from cleargs.rva.tables import BINS, FRAMES

SHOWN = 6
"""Most frames in a row of pictures."""

# Okabe and Ito's colours, which people with any colour vision can tell apart; roles differ in shape as well.
_ROLES = {
    Role.STRONG: ("#0072B2", "o"),
    Role.GEOMETRIC: ("#009E73", "^"),
    Role.AUXILIARY: ("#E69F00", "s"),
    Role.REACTIVATED: ("#CC79A7", "D"),
    Role.SUPPRESSED: ("#555555", "x"),
}
_BIN, _UNCOVERED = "#EEEEEE", "#F3CFE2"
_DPI = 100
_THUMBNAIL = 420  # px, long side
_ARROWS = 100  # more of them would hide the trajectory
_CROWDED = 400  # frames from which on single ones blur into each other: dots, and medians of 1 % of them
_MANY_BINS = 60  # from which on shades of every other bin would be a grating
_HEADLINE = 140  # letters of 12 points that fit on a line
_LETTER, _LINE = 8.0, 14.0  # px, width of a digit and height of a label of 9 points at _DPI


@dataclass(frozen=True, eq=False)
class Allocation:
    """RVA's tables of N training frames in trajectory order, with where their cameras stand."""

    evaluator: str
    frame_id: Ints  # [N]
    time_s: Floats  # [N], NaN without a clock
    images: Sequence[Path]  # [N]
    centres: Floats  # [N, 3] normalised world (y down), NaN without a pose
    directions: Floats  # [N, 3] unit vectors, NaN without a pose
    R: Floats  # [N], NaN where the frame could not be scored, like B
    B: Floats  # [N]
    G: Floats  # [N], NaN without a pose or scores
    bin: Ints  # [N], -1 without a pose or scores
    role: Roles  # [N]
    weight: Floats  # [N]
    stand_in: Bools  # [N] in the geometry's reference set because no frame is reliable
    covered: Bools  # [bins] active frames before reactivation

    @property
    def placed(self) -> Bools:  # [N]
        """Frames with a pose and scores: those that RVA allocates."""
        return np.asarray(self.bin >= 0)

    @property
    def along(self) -> tuple[Floats, str]:  # [N]
        """Where the frames stand on the time axis, and its label: seconds if all have a time, else ids."""
        if np.isnan(self.time_s).any():
            return self.frame_id.astype(np.float64), "frame"
        return self.time_s, "time (s)"


def load_allocation(rva: Path, ingest: Path) -> Allocation:
    """Read what the stages ``rva`` and ``ingest`` left in these folders. Raises StoreError."""
    table = read_table(rva / "frames.parquet", FRAMES)
    bins = read_table(rva / "bins.parquet", BINS)
    by_id = {frame.frame_id: frame for frame in load_frames(ingest)}
    frames = [by_id[frame_id] for frame_id in table["frame_id"].to_pylist()]
    poses = poses_from(frames)
    unposed = ~poses.registered[:, None]

    def numbers(values: Iterable[float | None]) -> Floats:
        return np.array([np.nan if value is None else value for value in values], dtype=np.float64)

    return Allocation(
        evaluator=table["evaluator"][0].as_py() if len(frames) else "",
        frame_id=np.array([frame.frame_id for frame in frames], dtype=np.int64),
        time_s=numbers(frame.time_s for frame in frames),
        images=[ingest / frame.image for frame in frames],
        centres=np.where(unposed, np.nan, camera_centres(poses.rotations, poses.translations)),
        directions=np.where(unposed, np.nan, view_directions(poses.rotations)),
        R=numbers(table["R"].to_pylist()),
        B=numbers(table["B"].to_pylist()),
        G=numbers(table["G"].to_pylist()),
        bin=table["bin"].fill_null(-1).to_numpy(),
        role=np.array(table["role"].to_pylist(), dtype=np.str_),
        weight=table["weight"].to_numpy(),
        stand_in=np.array(table["stand_in"].to_pylist(), dtype=bool),
        covered=np.array(bins["covered"].to_pylist(), dtype=bool),
    )


def extremes(allocation: Allocation, most: int = SHOWN) -> dict[str, list[int]]:
    """The frames worth looking at: title of a row of pictures -> their rows, at most ``most`` of each.

    The best and the worst by R - B, each the most extreme first (ties: the earlier); no frame is both, and
    the frames of a row lie a twentieth of the capture apart, or they would show one view over and over.
    Of more reactivated frames than fit, some spread evenly over the trajectory. Rows without frames are left
    out.
    """
    scored = np.flatnonzero(~np.isnan(allocation.R))
    margin = (allocation.R - allocation.B)[scored]
    gap = len(allocation.R) // 20
    best = _apart(scored[np.argsort(-margin, kind="stable")], min(most, (len(scored) + 1) // 2), gap)
    worst = _apart([k for k in scored[np.argsort(margin, kind="stable")] if k not in best], most, gap)
    reactivated = np.flatnonzero(allocation.role == Role.REACTIVATED)
    spread = np.unique(np.linspace(0, len(reactivated) - 1, min(most, len(reactivated))).round().astype(int))
    rows = {
        "best\nby R - B": best,
        "worst\nby R - B": worst,
        f"reactivated\n{len(spread)} of {len(reactivated)}": reactivated[spread].tolist(),
    }
    return {title: found for title, found in rows.items() if found}


def _apart(candidates: Iterable[int], most: int, gap: int) -> list[int]:
    """The first ``most`` candidates that are each at least ``gap`` from those before."""
    chosen: list[int] = []
    for row in candidates:
        if len(chosen) == most:
            break
        if all(abs(row - other) >= gap for other in chosen):
            chosen.append(int(row))
    return chosen


def plot_allocation(path: Path, allocation: Allocation, title: str) -> None:
    """Write a PNG: the cameras from above, R, B, G and weights along time, thumbnails of `extremes`.

    Raises InputError when no frame has both a pose and scores, or when a thumbnail cannot be read.
    """
    if not allocation.placed.any():
        raise InputError(
            "no frame has both a pose and scores: there is no trajectory to draw",
            hint="`cleargs show RUN ingest` and `cleargs show RUN rva` say what is missing",
        )
    shown = extremes(allocation)
    heights = [6.8, *[2.6] * len(shown)]
    figure = Figure(figsize=(16.0, sum(heights)), dpi=_DPI, layout="constrained")
    top, *strips = figure.subfigures(1 + len(shown), 1, height_ratios=heights, squeeze=False)[:, 0]
    top.suptitle(_headline(allocation, title), fontsize=12, parse_math=False)  # names may hold dollars
    columns = top.add_gridspec(3, 2, width_ratios=(1.0, 1.6), height_ratios=(2.0, 1.0, 1.4))
    scores = top.add_subplot(columns[0, 1])
    _draw_along_time(
        [scores, *(top.add_subplot(columns[row, 1], sharex=scores) for row in (1, 2))], allocation, shown
    )
    above = top.add_subplot(columns[:, 0])
    pictured = _draw_map(above, allocation, sorted({row for rows in shown.values() for row in rows}))
    top.legend(handles=_legend(allocation), loc="outside lower center", ncols=8, frameon=False, fontsize=9)
    for strip, (name, rows) in zip(strips, shown.items(), strict=True):
        _draw_thumbnails(strip, allocation, name, rows)
    figure.draw_without_rendering()  # where labels fit is known once the panels have their places
    _label_map(above, allocation, pictured)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png")


def _headline(allocation: Allocation, title: str) -> str:
    weight, covered = allocation.weight, allocation.covered
    stand_in = int(np.count_nonzero(allocation.stand_in))
    facts = [
        f"{np.count_nonzero(weight)} of {len(weight)} frames active, effective sample size "
        f"{effective_sample_size(weight):.1f}",
        f"{np.count_nonzero(~covered)} of {len(covered)} trajectory {'bin' if len(covered) == 1 else 'bins'} "
        "uncovered before compensation",
        *([f"no reliable frame, {stand_in} in their place"] if stand_in else []),
        f"judged by {allocation.evaluator}",
    ]
    return textwrap.fill(f"{title}: " + "; ".join(facts), _HEADLINE)


def _legend(allocation: Allocation) -> list[Line2D | Patch]:
    """Roles with their numbers of frames, then the shades of the bins."""
    entries: list[Line2D | Patch] = []
    for role, (colour, shape) in _ROLES.items():
        count = int(np.count_nonzero((allocation.role == role) & allocation.placed))
        entries.append(_mark(colour, shape, f"{role} ({count})"))
    absent = int(np.count_nonzero(~allocation.placed))
    if absent:
        entries.append(_mark(_ROLES[Role.SUPPRESSED][0], "|", f"no pose or no scores ({absent})"))
    if 1 < len(allocation.covered) < _MANY_BINS:
        entries.append(Patch(color=_BIN, label="every other bin"))
    if not allocation.covered.all():
        entries.append(Patch(color=_UNCOVERED, label="uncovered bin"))
    return entries


def _mark(colour: str, shape: str, label: str) -> Line2D:
    return Line2D([], [], color=colour, marker=shape, linestyle="none", label=label)


def _draw_map(panel: Axes, allocation: Allocation, pictured: Sequence[int]) -> list[int]:
    """Cameras from above: x to the right, z up the page, as a camera looking along +z sees left and right.

    Returns the rows to label, which are ringed: those ``pictured`` that have a pose, and both ends.
    """
    x, z = allocation.centres[:, 0], allocation.centres[:, 2]
    posed = np.flatnonzero(~np.isnan(x))
    panel.plot(x[posed], z[posed], color="0.75", linewidth=1.0, zorder=1)
    some = posed[:: -(-len(posed) // _ARROWS)]
    look = allocation.directions[some]
    panel.quiver(
        x[some], z[some], look[:, 0], look[:, 2],
        angles="xy", scale_units="width", scale=22.0, width=0.0025, color="0.6", zorder=2,
    )  # fmt: skip
    dense = np.clip(200.0 / len(posed), 0.15, 1.0)
    _draw_frames(panel, allocation, x, z, sizes=dense * (14.0 + 50.0 * allocation.weight))
    ringed = sorted({*pictured, posed[0], posed[-1]} & {*posed})
    panel.scatter(
        x[ringed], z[ringed], s=130, facecolors="none", edgecolors="black", linewidths=0.8, zorder=6
    )
    panel.set_aspect("equal", adjustable="datalim")
    panel.margins(0.12)
    if not max(np.ptp(x[posed]), np.ptp(z[posed])):  # a camera that stays put
        panel.update_datalim([(x[posed[0]] - 0.5, z[posed[0]] - 0.5), (x[posed[0]] + 0.5, z[posed[0]] + 0.5)])
    panel.set_title("from above; arrow: view, size: weight, ring: end or pictured", fontsize=10)
    panel.set_xlabel("x (normalised world)")
    panel.set_ylabel("z")
    panel.grid(alpha=0.2)
    return [int(row) for row in ringed]


def _label_map(panel: Axes, allocation: Allocation, rows: Sequence[int]) -> None:
    """Write the frame ids of ``rows`` beside their rings."""
    places = panel.transData.transform(allocation.centres[:, [0, 2]])
    places = places[~np.isnan(places[:, 0])]
    rings = panel.transData.transform(allocation.centres[rows][:, [0, 2]])
    ends = {rows[0]: " (start)", rows[-1]: " (end)"} if len(rows) > 1 else {}
    texts = [f"{allocation.frame_id[row]}{ends.get(row, '')}" for row in rows]
    sizes = np.array([(_LETTER * len(text), _LINE) for text in texts])
    middles = place_labels(rings, sizes, places, np.asarray(panel.get_window_extent().extents))
    for text, (x, z), shift in zip(
        texts, allocation.centres[rows][:, [0, 2]], (middles - rings) * 72.0 / _DPI, strict=True
    ):
        panel.annotate(
            text, (x, z), xytext=(shift[0], shift[1]),
            textcoords="offset points", fontsize=9, ha="center", va="center", zorder=8,
            arrowprops={"arrowstyle": "-", "color": "0.35", "linewidth": 0.6, "shrinkA": 0.0, "shrinkB": 5.5},
            path_effects=[withStroke(linewidth=2.5, foreground="white")],
        ).set_in_layout(False)  # fmt: skip


def place_labels(
    anchors: Floats,  # [K, 2] px
    sizes: Floats,  # [K, 2] px
    marks: Floats,  # [M, 2] px
    frame: Floats,  # left, bottom, right, top in px
) -> Floats:  # [K, 2] px
    """Middles of labels near their anchors: off each other and inside the frame if it can be done, then over
    as few marks as possible, then close by. In the order given, each at the best of some places around it.
    """
    turns = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False) + np.pi / 4.0
    around = np.column_stack([np.cos(turns), np.sin(turns)])
    middles = np.zeros((0, 2))
    for anchor, size in zip(anchors, sizes, strict=True):
        reach = np.repeat([14.0, 24.0, 38.0, 56.0, 78.0, 104.0], len(turns))[:, None]  # px
        offers = anchor + np.tile(around, (6, 1)) * (reach + 0.5 * size)
        apart = np.abs(offers[:, None] - middles) - 0.5 * (size + sizes[: len(middles)])
        labels = np.count_nonzero((apart < (6.0, 2.0)).all(axis=-1), axis=1)
        outside = ((offers - 0.5 * size < frame[:2]) | (offers + 0.5 * size > frame[2:])).any(axis=1)
        covered = np.count_nonzero((np.abs(offers[:, None] - marks) < 0.5 * size + 4.0).all(axis=-1), axis=1)
        cost = 1e6 * (labels + outside) + 10.0 * np.minimum(covered, 10) + reach[:, 0]
        middles = np.vstack([middles, offers[np.argmin(cost)]])
    return middles


def _draw_frames(panel: Axes, allocation: Allocation, x: Floats, y: Floats, sizes: Floats) -> None:
    """A mark a frame in the colour and shape of its role; rarer roles lie on top."""
    groups = [
        *(((allocation.role == role) & allocation.placed, *style) for role, style in _ROLES.items()),
        (~allocation.placed, _ROLES[Role.SUPPRESSED][0], "|"),
    ]
    for among, colour, shape in sorted(groups, key=lambda group: -np.count_nonzero(group[0])):
        panel.scatter(x[among], y[among], s=sizes[among], c=colour, marker=shape, linewidths=1.0, zorder=4)


def _draw_along_time(panels: Sequence[Axes], allocation: Allocation, shown: Mapping[str, list[int]]) -> None:
    """R and B, G, and the weights over bins in shades; thin lines at the pictured frames, their ids above."""
    scores, geometry, weights = panels
    x, axis = allocation.along
    for panel in panels:
        _shade_bins(panel, allocation, x)
        for row in {row for rows in shown.values() for row in rows}:
            panel.axvline(x[row], color="0.7", linewidth=0.6, zorder=1)
        panel.set_axisbelow(True)
        panel.grid(axis="y", alpha=0.25)
        panel.margins(x=0.02)
    if not np.ptp(x):
        scores.set_xlim(x[0] - 0.5, x[0] + 0.5)
    _draw_curve(scores, x, allocation.R, "R, reliability", "#000000", "-")
    _draw_curve(scores, x, allocation.B, "B, degradation risk", "#D55E00", "--")
    _draw_curve(geometry, x, allocation.G, "G, geometric utility", "#000000", "-")
    scores.set(ylim=(-0.03, 1.03), ylabel="R, B")
    top = max(0.1, 1.1 * float(np.nanmax(allocation.G)))
    geometry.set(ylim=(-0.05 * top, top), ylabel="G")
    weights.set(ylim=(-0.08, 1.08), ylabel="weight", xlabel=axis)
    scores.tick_params(labelbottom=False)
    geometry.tick_params(labelbottom=False)
    if len(x) < _CROWDED:
        colours = [_ROLES[Role(role)][0] for role in allocation.role]
        weights.vlines(x, 0.0, allocation.weight, colors=colours, linewidth=1.0, zorder=2)
    sizes = np.full(len(x), 22.0 if len(x) < _CROWDED else 7.0)
    _draw_frames(weights, allocation, x, allocation.weight, sizes)
    _name_pictures(scores, allocation, x, shown)


def _draw_curve(panel: Axes, x: Floats, values: Floats, label: str, colour: str, style: str) -> None:
    """A line through the frames; of many, faint dots and the running median of 1 % of them."""
    if len(x) < _CROWDED:
        panel.plot(x, values, style, marker=".", color=colour, linewidth=1.2, label=label, zorder=3)
        return
    known = ~np.isnan(values)
    panel.scatter(x[known], values[known], s=3.0, color=colour, alpha=0.4, linewidths=0.0, zorder=2)
    median = median_filter(values[known], size=len(x) // 100, mode="nearest")
    panel.plot(x[known], median, style, color=colour, linewidth=1.5, label=f"{label} (median)", zorder=3)


def _name_pictures(panel: Axes, allocation: Allocation, x: Floats, shown: Mapping[str, list[int]]) -> None:
    """Frame ids above the panel, a line a row of pictures, and the legend above them."""
    height = 1.02
    for name, rows in reversed(list(shown.items())):
        across = panel.get_xaxis_transform()
        for row in rows:
            panel.text(
                x[row], height, str(allocation.frame_id[row]), transform=across, fontsize=9, ha="center"
            )
        word = name.split("\n")[0]
        panel.text(-0.01, height, word, transform=panel.transAxes, fontsize=9, ha="right")
        height += 0.075
    panel.legend(
        loc="lower right", bbox_to_anchor=(1.0, height), borderaxespad=0.2, ncols=2, frameon=False, fontsize=9
    )


def _shade_bins(panel: Axes, allocation: Allocation, x: Floats) -> None:
    """Uncovered bins in one shade, every other one of the rest in another; borders lie between frames."""
    placed = np.flatnonzero(allocation.placed)
    changes = np.flatnonzero(np.diff(allocation.bin[placed])) + 1
    groups = np.split(placed, changes)
    inner = [0.5 * (x[before[-1]] + x[after[0]]) for before, after in pairwise(groups)]
    borders = [x[placed[0]], *inner, x[placed[-1]]]
    for group, (left, right) in zip(groups, pairwise(borders), strict=True):
        index = int(allocation.bin[group[0]])
        if not allocation.covered[index]:
            panel.axvspan(left, right, color=_UNCOVERED, linewidth=0.0, zorder=0)
        elif index % 2 and len(allocation.covered) < _MANY_BINS:
            panel.axvspan(left, right, color=_BIN, linewidth=0.0, zorder=0)


def _draw_thumbnails(strip: SubFigure, allocation: Allocation, title: str, rows: Sequence[int]) -> None:
    """A row of pictures, framed in the colours of their roles."""
    panels = strip.subplots(1, SHOWN, squeeze=False)[0]
    for panel in panels[len(rows) :]:
        panel.axis("off")
    for panel, row in zip(panels, rows, strict=False):
        panel.imshow(_thumbnail(allocation.images[row]))
        panel.set_xticks([])
        panel.set_yticks([])
        for spine in panel.spines.values():
            spine.set(color=_ROLES[Role(allocation.role[row])][0], linewidth=4.0)
        panel.set_title(_caption(allocation, row), fontsize=9)
    panels[0].set_ylabel(title, fontsize=11)


def _caption(allocation: Allocation, row: int) -> str:
    when = "" if np.isnan(allocation.time_s[row]) else f" at {allocation.time_s[row]:.2f} s"
    scores = f"R {allocation.R[row]:.2f}  B {allocation.B[row]:.2f}"
    if not allocation.placed[row]:
        return f"frame {allocation.frame_id[row]}{when}: no pose\n{scores}"
    return (
        f"frame {allocation.frame_id[row]}{when}: {allocation.role[row]}\n"
        f"{scores}  G {allocation.G[row]:.2f}  weight {allocation.weight[row]:.2f}"
    )


def _thumbnail(path: Path) -> NDArray[np.uint8]:  # [h, w, 3]
    image = read_rgb(path)
    height, width = image.shape[:2]
    shrink = min(1.0, _THUMBNAIL / max(height, width))
    size = max(1, round(width * shrink)), max(1, round(height * shrink))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
