"""The first scene (stage g0) at full size on a GPU, from a run that was prepared elsewhere.

    python tests/gpu/splat_stages.py RUN OUT [--steps 7000] [--budget 500000] [--device cuda]

RUN holds the finished folders ``ingest`` and ``rva``, made by ``cleargs run CAPTURE -o RUN --until rva`` on
any machine, with ``--set ingest.holdout=every:8`` for held-out frames, and ``--set ingest.max_size=...``
where images are larger than 960 px. It may be packed, see ``pack_run.py``. OUT gets the scene, its log and
``stages.json``: time, PSNR of training and held-out frames, and memory. After a time limit, the same command
resumes from the checkpoint.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from pack_run import unpack

from cleargs.capture.tables import load_frames
from cleargs.formation.exposure import read_exposure
from cleargs.pipeline.stage import StageContext
from cleargs.progress import SilentReporter
from cleargs.scene.measure import evaluate_views
from cleargs.scene.views import view_of
from cleargs.splat.ply import read_ply

# `stages` is the package `cleargs.stages` as it is in the repository: nothing needs to be installed.
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from stages import g0


class Lines(SilentReporter):
    """Print remarks and warnings."""

    def info(self, text: str) -> None:
        print(text, flush=True)

    warn = info


def train(run: Path, out: Path, config: g0.G0Config, device: Any) -> dict[str, Any]:
    """Run the stage and return its summary, duration and memory."""
    inputs = {name: (run / name).resolve(strict=True) for name in ("ingest", "rva")}
    folders = {name: out / name for name in ("g0", "checkpoints", "kept")}
    for folder in folders.values():
        folder.mkdir(parents=True, exist_ok=True)
    going_on = any(folders["checkpoints"].iterdir())
    start = time.perf_counter()
    result = g0.run(
        StageContext(
            config=config,
            source=run,
            inputs=inputs,
            externals={},
            out=folders["g0"],
            checkpoints=folders["checkpoints"],
            cache=folders["kept"],
            seed=0,
            device=device,
            threads=torch.get_num_threads(),
            reporter=Lines(),
        )
    )
    seconds = time.perf_counter() - start
    return {
        "seconds": None if going_on else round(seconds, 1),  # with decoding and evaluation
        **result.summary,
        "psnr_held_out": held_out(inputs["ingest"], folders["g0"], device),
        "peak_memory_gb": round(torch.cuda.max_memory_allocated() / 1e9, 2) if device == "cuda" else None,
    }


def held_out(ingest: Path, scene_folder: Path, device: Any) -> float | None:
    """Return the mean PSNR in dB of held-out frames; None if there are none."""
    frames = [frame for frame in load_frames(ingest) if frame.registered and frame.split == "test"]
    views = [view_of(frame, ingest, 1.0) for frame in frames]
    scene = read_ply(scene_folder / "scene.ply").to(device)
    fits = evaluate_views(scene, views, read_exposure(scene_folder / "exposure.parquet"))
    return fmean(fit.psnr for fit in fits) if fits else None


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--steps", type=int, default=7000)
    parser.add_argument("--budget", type=int, default=500_000)
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cuda")
    arguments = parser.parse_args()
    config = g0.G0Config(steps=arguments.steps, budget=arguments.budget)
    run = unpack(arguments.run, arguments.out / "run")
    found = train(run, arguments.out, config, arguments.device)
    name = torch.cuda.get_device_name() if arguments.device == "cuda" else "cpu"
    found |= {"device": name, "torch": torch.__version__, "python": sys.version.split()[0]}
    (arguments.out / "stages.json").write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
