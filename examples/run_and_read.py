"""Run all stages on a capture and print the results.

python run_and_read.py CAPTURE RUN [RECIPE]
"""

import sys

import cleargs as cg

if len(sys.argv) not in (3, 4):
    sys.exit(__doc__)
capture, folder, *recipe = sys.argv[1:]
run = cg.run(capture, folder, recipe=recipe[0] if recipe else None, progress=print)
for stage in run.stages:
    print(stage, run[stage].summary)

frames = run["rva"].table("frames").select(["name", "role", "weight"])
for row in frames.to_pylist():
    print(f"{row['name']}: {row['role']}, weight {row['weight']:.2f}")
print(f"{run.scene().gaussians.num} Gaussians")
