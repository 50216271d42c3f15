#!/usr/bin/env bash
# torch.set_flush_denormal(True) is called, then 4 million numbers of 1e-40 are multiplied by 1 on 4 threads.
# Guess: all of them become 0, or none; where the call stands in the program does not matter.
# Seen: the call sets the calling thread alone. If the threads were running, the calling thread's quarter of the numbers is 0 and
# the rest is not. If the call came before the first parallel work, all are 0, and three quarters stay 0 after it was taken back.
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
env/bin/python -m pip install --quiet --disable-pip-version-check torch==2.13.0 numpy==2.4.6 ||
  cannot "the packages could not be installed"
env/bin/python - <<'EOF'
import subprocess
import sys

PROGRAM = '''
import sys
import numpy as np
import torch

torch.set_num_threads(4)
values = torch.from_numpy(np.full(4_000_000, 1e-40, np.float32))

def zeros():
    bits = torch.empty_like(values)
    torch.mul(values, 1.0, out=bits)
    return round(float((bits.numpy().view(np.int32) == 0).mean()), 3)

shares = [zeros()] if sys.argv[1] == "running" else []
if not torch.set_flush_denormal(True):
    sys.exit("unsupported")
shares.append(zeros())
torch.set_flush_denormal(False)
shares.append(zeros())
print(torch.__version__, *shares)
'''
print("guess: 0, 1, 0 and 1, 0")
seen = []
for order in ("running", "first"):
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", PROGRAM, order], capture_output=True, text=True)
    if "unsupported" in done.stderr:
        print("cannot be tried here: this processor does not flush denormal numbers")
        sys.exit(2)
    version, *shares = done.stdout.split()
    seen.append([float(share) for share in shares])
    when = "after the threads had started" if order == "running" else "before the first parallel work"
    print(f"torch {version}, flushing switched on {when}: shares of zeros {seen[-1]}")
as_described = seen[0][0] == 0 and 0.1 < seen[0][1] < 0.9 and seen[1][0] == 1 and 0.1 < seen[1][1] < 0.9
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
