#!/usr/bin/env bash
# A compiled loop that copies a matrix into a larger array: by an assignment of the whole matrix, and by two loops.
# Guess: Numba compiles the same few things for both; an assignment is the simple form.
# Seen: the assignment also compiles functions of text, which join the shapes for the message of an error.
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
import time

import numba
import numpy as np
from numba import njit
from numba.core import event

print("Numba", numba.__version__)


class Compiled(event.Listener):
    """Names of the functions that are compiled."""

    def __init__(self):
        self.names = []

    def on_start(self, found):
        function = found.data["dispatcher"].py_func
        self.names.append(f"{function.__module__.rsplit('.', 1)[-1]}.{function.__name__}")

    def on_end(self, found):
        pass


def by_assignment(matrix, out):
    for k in range(len(out)):
        out[k] = matrix


def by_loops(matrix, out):
    for k in range(len(out)):
        for i in range(matrix.shape[0]):
            for j in range(matrix.shape[1]):
                out[k, i, j] = matrix[i, j]


texts, results = {}, []
matrix = np.arange(6.0).reshape(2, 3)
for function in (by_loops, by_assignment):
    seen, out = Compiled(), np.zeros((4, 2, 3))
    begun = time.process_time()
    with event.install_listener("numba:compile", seen):
        njit(function)(matrix, out)
    texts[function.__name__] = [name for name in seen.names if name.startswith("unicode.")]
    results.append(out)
    print(
        f"{function.__name__}: {len(seen.names)} functions compiled, {len(texts[function.__name__])} of them of text,"
        f" {time.process_time() - begun:.1f} s"
    )
print("guess: no function of text in either")
as_described = not texts["by_loops"] and len(texts["by_assignment"]) > 3 and np.array_equal(*results)
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
