#!/usr/bin/env bash
# The same tensors and the same metadata are saved by safetensors in four processes.
# Guess: four equal files, as the order of a Python dict is fixed.
# Seen: the order of two or more metadata keys is random in each process, so digests differ. With one key they are equal.
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
env/bin/python -m pip install --quiet --disable-pip-version-check safetensors==0.8.0 numpy==2.4.6 ||
  cannot "the packages could not be installed"
env/bin/python - <<'EOF'
import subprocess
import sys

PROGRAM = '''
import hashlib, json, sys
import numpy as np
import safetensors
from safetensors.numpy import save
tensors = {"means": np.zeros((4, 3), np.float32), "opacities": np.ones(4, np.float32)}
print(safetensors.__version__, hashlib.sha256(save(tensors, metadata=json.loads(sys.argv[1]))).hexdigest()[:16])
'''
MANY = '{"unit": "m", "up": "z", "degree": "3", "scene": "room", "steps": "1000", "seed": "1"}'


def digests(metadata):
    runs = [subprocess.check_output([sys.executable, "-c", PROGRAM, metadata], text=True).split() for _ in range(6)]
    return runs[0][0], [digest for _, digest in runs]


print("guess: one digest each")
version, one = digests('{"unit": "m"}')
many = digests(MANY)[1]
print(f"safetensors {version}: one key {len(set(one))}, six keys {len(set(many))} digests in 6 processes")
as_described = len(set(one)) == 1 and len(set(many)) > 1
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
