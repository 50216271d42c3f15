#!/usr/bin/env bash
# A kernel with cache=True calls a function of another file, also with cache=True. That function is changed.
# Guess: the next process compiles what depends on it again, as make does.
# Seen: only the changed file is compiled again. The kernel gives the old result from its cache, with no message, while the
# function itself, called beside it, gives the new one.
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
cat >weights.py <<'EOF'
from numba import njit

@njit(cache=True)
def weight(x):
    return 2.0 * x
EOF
cat >kernel.py <<'EOF'
import numba
from numba import njit
from weights import weight

@njit(cache=True)
def total(x):
    return weight(x) + 1.0

print("Numba", numba.__version__, "total(10) =", total(10.0), "weight(10) =", weight(10.0))
EOF
export NUMBA_CACHE_DIR="$work/cache"
before=$(env/bin/python kernel.py)
sed -i 's/2\.0/3.0/' weights.py
after=$(env/bin/python kernel.py)
echo "guess: 21 and 20 before, 31 and 30 after weights.py was changed from 2 to 3"
echo "before: $before"
echo "after:  $after"
case "$before|$after" in
  *"= 21.0"*"= 20.0|"*"= 21.0"*"= 30.0") echo "as described" ;;
  *) echo "CHANGED"; exit 1 ;;
esac
