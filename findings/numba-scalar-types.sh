#!/usr/bin/env bash
# One function runs as Python (NumPy 2) and compiled by Numba: the difference of two 8-bit pixels, and a float32 number times 0.1.
# Guess: the same types and values: 254 (wrapped to 8 bits), and float32.
# Seen: Numba computes the difference in 64 bits without a sign, 18446744073709551614, so its square is right and its absolute
# value and its float are not; and 0.1 turns float32 into float64, also in sums that start as float32.
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

print("Numba", numba.__version__, "NumPy", np.__version__)


def difference(a, b):
    return a[0] - b[0]


def as_float(a, b):
    return float(a[0] - b[0])


def scaled(a):
    return a[0] * 0.1


def total(a):
    s = np.float32(0)
    for k in range(a.size):
        s += a[k] * 0.1
    return s


dark, light = np.array([3], np.uint8), np.array([5], np.uint8)
values = np.full(4, 0.3, np.float32)
seen = {}
with np.errstate(over="ignore"):
    for function, arguments in ((difference, (dark, light)), (as_float, (dark, light)), (scaled, (values,)), (total, (values,))):
        compiled = numba.njit(function)
        by_python, by_numba = function(*arguments), compiled(*arguments)
        kind = compiled.nopython_signatures[0].return_type
        seen[function.__name__] = int(by_numba) if kind in numba.types.integer_domain else str(kind)
        print(f"{function.__name__}: Python {by_python} ({type(by_python).__name__}), Numba {by_numba} ({kind})")
print("guess: both columns equal")
as_described = seen["difference"] == 2**64 - 2 and seen["scaled"] == seen["total"] == "float64"
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
