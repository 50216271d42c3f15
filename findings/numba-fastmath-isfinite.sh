#!/usr/bin/env bash
# A kernel that leaves out pixels that are not finite is compiled with fastmath=True to make it faster.
# Guess: fastmath changes rounding; np.isfinite is a question, and its answer stays.
# Seen: np.isfinite says True for every NaN, and np.isnan False, without a warning. A set of flags without nnan and ninf keeps
# both right.
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
env/bin/python -m pip install --quiet --disable-pip-version-check numba==0.68.1 numpy==2.4.6 ||
  cannot "the packages could not be installed"
env/bin/python - <<'EOF'
import sys

import numba
import numpy as np

print("Numba", numba.__version__)


def mean_of_finite(values):
    total, count = 0.0, 0
    for k in range(values.size):
        if np.isfinite(values[k]):
            total += values[k]
            count += 1
    return total / count, count


values = np.ones(99, np.float32)
values[::3] = np.nan
some_flags = {"nsz", "arcp", "contract", "afn", "reassoc"}
print("guess: mean 1 of 66 numbers in all cases")
seen = {}
for name, flags in {"none": False, "fastmath=True": True, "all flags but nnan and ninf": some_flags}.items():
    seen[name] = numba.njit(fastmath=flags)(mean_of_finite)(values)
    print(f"{name}: mean {seen[name][0]} of {seen[name][1]} numbers")
as_described = (
    seen["none"] == (1.0, 66) == seen["all flags but nnan and ninf"]
    and seen["fastmath=True"][1] == 99 and np.isnan(seen["fastmath=True"][0])
)
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
