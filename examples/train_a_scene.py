"""Train a scene on the prepared capture of a run.

python train_a_scene.py RUN SCENE.ply [STEPS]
"""

import sys

import cleargs as cg

if len(sys.argv) not in (3, 4):
    sys.exit(__doc__)
folder, output, *steps = sys.argv[1:]
run = cg.open_run(folder)
capture = cg.open_prepared(run["ingest"])
views = capture.views(run["rva"].weights())

config = cg.TrainConfig(steps=int(steps[0]) if steps else 1000)
start = cg.initialise(capture, views, cg.G0Config(sh_degree=1, min_points=5000))
result = cg.train(start, views, config, seed=1, progress=print)
cg.save(result.scene, output)

image = cg.render_view(result.scene, views[0].camera).image  # [H, W, 3], torch
print(f"{result.scene.gaussians.num} Gaussians; mean of frame {views[0].frame_id}: {float(image.mean()):.2f}")
