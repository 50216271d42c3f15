"""Quality of RIVR's candidates against a known sharp truth.

python tests/rivr/against_truth.py RUN...     PSNR and LPIPS of every layer of the EXRs of finished runs

RUN is of a capture by `cleargs synth`. Mean over the target frames, each round; "chosen" is what supervised.
"""

from __future__ import annotations

import sys
import tomllib
from collections import defaultdict
from pathlib import Path

import numpy as np

from cleargs.capture.tables import load_frames
from cleargs.media.exr import from_layer, read_exr
from cleargs.media.image import read_rgb
from cleargs.models.lpips import load_lpips
from cleargs.rivr.tables import read_selection

LAYERS = ("observed", "deblurred", "render", "restored", "fused")


def main(runs: list[Path]) -> None:
    """Print a table of every run."""
    lpips = load_lpips()
    for run in runs:
        capture = Path(tomllib.loads((run / "run.toml").read_text())["input"])
        folder = capture / "truth" / "observed" / "images"
        truths = {
            frame.frame_id: folder / f"{Path(frame.name).stem}.png" for frame in load_frames(run / "ingest")
        }
        figures: dict[tuple[int, str], list[tuple[float, float]]] = defaultdict(list)
        for row in read_selection(run / "rivr" / "selection.parquet"):
            if row.exr is None:
                continue
            truth = np.float32(1 / 255) * read_rgb(truths[row.frame_id])
            images = {
                name: from_layer(layer) for name, layer in read_exr(run / "rivr" / row.exr).layers.items()
            }
            for name, image in {**images, "chosen": images[row.chosen]}.items():
                psnr = -10.0 * np.log10(np.mean((image - truth) ** 2))
                figures[row.round, name].append((float(psnr), lpips.distance(image, truth)))
        print(f"{capture.name}: PSNR / LPIPS to the truth")
        for number in sorted({number for number, _ in figures}):
            cells = {
                n: np.mean(figures[number, n], axis=0) for n in (*LAYERS, "chosen") if (number, n) in figures
            }
            print(f"  round {number}:", *(f"{name} {p:.2f} / {d:.4f}  " for name, (p, d) in cells.items()))


if __name__ == "__main__":
    main([Path(argument) for argument in sys.argv[1:]])
