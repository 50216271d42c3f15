#!/usr/bin/env bash
# safetensors writes the same tensors over a file that the group may write to, and into a new file.
# Guess: the first keeps its permissions, and the second gets those of any new file.
# Seen: version 0.7.0 does so. With 0.8.0 both may be read by their owner alone, whatever the umask is.
# Exit: 0 as described, 1 changed, 2 cannot be tried here.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cannot() {
  echo "cannot be tried here: $1"
  exit 2
}
cd "$work"
python3 -m venv before || cannot "python3 with its module venv is missing"
python3 -m venv now || cannot "python3 with its module venv is missing"
before/bin/python -m pip install --quiet --disable-pip-version-check safetensors==0.7.0 numpy==2.4.6 ||
  cannot "the packages could not be installed"
now/bin/python -m pip install --quiet --disable-pip-version-check safetensors==0.8.0 numpy==2.4.6 ||
  cannot "the packages could not be installed"
cat > modes.py <<'EOF'
import os
from pathlib import Path

import numpy as np
from safetensors.numpy import save_file

os.umask(0o022)
scene = {"means": np.zeros((4, 3), np.float32)}
Path("old").touch()
os.chmod("old", 0o664)
for name in ("old", "new"):
    save_file(scene, name)
    print(f"{os.stat(name).st_mode & 0o777:o}", end=" ")
    os.remove(name)
EOF
echo "guess: 664 644"
before=$(before/bin/python modes.py)
now=$(now/bin/python modes.py)
echo "safetensors 0.7.0: $before"
echo "safetensors 0.8.0: $now"
if [ "$before" = "664 644 " ] && [ "$now" = "600 600 " ]; then echo "as described"; else
  echo "CHANGED"
  exit 1
fi
