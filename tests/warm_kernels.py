"""Compile the kernels into the cache before the tests, so that test processes do not compile the same ones.

Two processes compile a half each. With the kernels in the cache, this takes a few seconds.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np


def compile_half(half: str) -> None:
    """Compile the kernels that render and search for motion ("first"), or all others ("second")."""
    import torch

    from cleargs.formation.comparison import FramePair
    from cleargs.formation.search import search
    from cleargs.splat.kernels.cpu import backend
    from cleargs.splat.kernels.cuda.self_test import Sizes, View, checks
    from cleargs.splat.random_scene import random_scene
    from cleargs.synth.synthetic_capture import make_capture

    views = {"outputs": View(20, 18, 17, all_outputs=True), "rolls": View(25, 20, 16, rolls=True)}
    for name, run in checks(Sizes(views, (24, 50), 200, View(20, 16, 16), 4)).items():
        if (name in views) == (half == "first"):
            run(backend, torch.device("cpu"))
    if half == "first":
        image = np.random.default_rng(0).random((44, 60), dtype=np.float32)
        frame = image[6:-6, 6:-6].copy()
        ones, camera = np.ones_like(image), random_scene(1, 48, 32)[1]
        search(FramePair(image, ones, ones, frame, np.ones_like(frame), camera, 6), pose=True)
    else:
        with tempfile.TemporaryDirectory() as folder:
            make_capture(Path(folder) / "room", frames=2, width=64, height=48)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        compile_half(sys.argv[1])
    else:
        halves = [subprocess.Popen([sys.executable, __file__, half]) for half in ("first", "second")]
        if failed := max(process.wait() for process in halves):
            sys.exit(failed)
        from cleargs.splat import compilation

        compilation.main()  # the others; runs of tests then start no process that compiles
