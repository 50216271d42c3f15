#!/usr/bin/env bash
# The mean of a point cloud of 3 million points in float32, by points.mean(axis=0).
# Guess: right to 6 digits, since NumPy sums pairwise.
# Seen: along that axis it does not: the mean of points between 100 and 101 is 98.6, outside of the cloud. The same numbers in
# three columns, or dtype=float64, give 100.5.
# Exit: 0 as described, 1 changed, 2 cannot be tried here.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cannot() {
  echo "cannot be tried here: $1"
  exit 2
}
cd "$work"
python3 -m venv env || cannot "python3 with its module venv is missing"
env/bin/python -m pip install --quiet --disable-pip-version-check numpy==2.4.6 ||
  cannot "the packages could not be installed"
env/bin/python - <<'EOF'
import sys

import numpy as np

print("NumPy", np.__version__)
points = np.random.default_rng(0).random((3_000_000, 3), np.float32) + np.float32(100)
by_rows = points.mean(axis=0)
by_columns = np.ascontiguousarray(points.T).mean(axis=1)
by_float64 = points.mean(axis=0, dtype=np.float64)
print("guess: the mean is between the least and the largest coordinate")
print("least", points.min(axis=0), "largest", points.max(axis=0))
print("mean(axis=0)", by_rows, "of columns", by_columns, "in float64", by_float64)
as_described = bool((by_rows < points.min(axis=0)).all() and np.abs(by_columns - by_float64).max() < 1e-3)
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
