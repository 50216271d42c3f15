"""Measure the scenes of a run against sharp images.

python evaluate_scenes.py RUN REFERENCE
"""

import sys

import cleargs as cg
from cleargs.evaluate.config import EvalOptions

if len(sys.argv) != 3:
    sys.exit(__doc__)
folder, reference = sys.argv[1:]
run = cg.open_run(folder)
options = EvalOptions(lpips=(), scorers=("clarity-net",))
for stage in run.stages:
    if (run.folder / stage / "scene.ply").is_file():
        found = cg.evaluate_scene(run, reference, stage=stage, options=options)
        print(stage, ", ".join(f"{metric} {value:.3f}" for metric, value in found.means.items()))
