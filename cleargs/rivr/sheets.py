"""The contact sheets of RIVR and the consolidation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from cleargs.media.contact_sheet import Tile, contact_sheet
from cleargs.media.exr import from_layer
from cleargs.media.image import write_rgb
from cleargs.rivr.candidates import CANDIDATES
from cleargs.rivr.distillation import TrainedScene, observation
from cleargs.rivr.tables import Selection
from cleargs.splat.views import TrainingView

SHEET_FRAMES = 6
"""Frames on a sheet."""


def write_candidates_sheet(path: Path, rows: Sequence[Selection], rivr: Path) -> None:
    """Write one line per row: the observation, the same without its motion, and its candidates.

    Candidates have both scores, and a repair that was chosen is marked. A frame that is kept as filmed is
    not: image formation simulates what its camera did.
    """
    write_rgb(path, contact_sheet([_candidates(row, rivr) for row in rows] or [_nothing()]))


def write_before_after_sheet(
    path: Path,
    views: Sequence[TrainingView],
    before: TrainedScene,
    after: TrainedScene,
    repairs: Mapping[int, Selection],
    rivr: Path,
) -> None:
    """Write one line per view: G0's render, the final render, the observation and any distilled repair."""
    repaired = any(view.frame_id in repairs for view in views)
    lines = []
    for view in views:
        line = [
            Tile(before.render(view), f"frame {view.frame_id}: G0"),
            Tile(after.render(view), "final"),
            Tile(observation(view)[0], "observed"),
        ]
        if (row := repairs.get(view.frame_id)) is not None:
            image = from_layer(row.layers(rivr)[row.chosen])
            line.append(Tile(image, f"repair: {row.chosen}, round {row.round}"))
        elif repaired:
            line.append(Tile(None, "no repair"))
        lines.append(line)
    write_rgb(path, contact_sheet(lines or [_nothing()]))


def _candidates(row: Selection, rivr: Path) -> list[Tile]:
    layers = row.layers(rivr)
    head = f"frame {row.frame_id}, round {row.round}: {'kept ' if row.chosen == 'observed' else ''}as filmed"
    if row.primary_observed is not None:
        head += f" {row.primary_observed:.1f} / {row.tiebreak_observed:.1f}"
    tiles = [Tile(from_layer(layers["observed"]), head)]
    if "deblurred" in layers:
        motion = f"undone: blur {row.blur_px:.1f} px, skew {row.skew_px:.1f} px"
        tiles.append(Tile(from_layer(layers["deblurred"]), motion))
    for name in CANDIDATES:
        if name in layers:
            scores = f"{getattr(row, f'primary_{name}'):.1f} / {getattr(row, f'tiebreak_{name}'):.1f}"
            tiles.append(Tile(from_layer(layers[name]), f"{name} {scores}", marked=row.chosen == name))
    return tiles


def _nothing() -> list[Tile]:
    return [Tile(None, "no frame was repaired")]
