#!/usr/bin/env bash
# A Python program imports onnxruntime on Linux.
# Guess: telemetry exists in the builds for Windows only, as docs/Privacy.md said until 2026, and an import writes nothing.
# Seen: from 1.29 on, the import alone writes the number of a device and a database of events into the home, and .ses into
# TMPDIR, and the library has the address to which events are sent. ORT_DISABLE_TELEMETRY=1, set before the import, stops it.
# The variable CI, which build servers set, stops it too. That something is sent was not observed: the script has no such test.
# Exit: 0 as described, 1 changed, 2 cannot be tried here.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cannot() {
  echo "cannot be tried here: $1"
  exit 2
}
cd "$work"
[ "$(uname -s)" = Linux ] || cannot "this is not Linux"
python3 -m venv env || cannot "python3 with its module venv is missing"
env/bin/python -m pip install --quiet --disable-pip-version-check onnxruntime==1.31.1 numpy==2.4.6 ||
  cannot "the packages could not be installed"
env/bin/python -c 'import onnxruntime; print("onnxruntime", onnxruntime.__version__)'
echo "guess: an import leaves no files"
left() {
  mkdir "$1"
  env -i PATH="$PATH" HOME="$work/$1" TMPDIR="$work/$1" "${@:2}" env/bin/python -c 'import onnxruntime'
  (cd "$1" && find . -type f | sort)
}
plain=$(left plain)
echo "left by an import:" $plain
off=$(left off ORT_DISABLE_TELEMETRY=1)
echo "left with ORT_DISABLE_TELEMETRY=1:" ${off:-nothing}
address=$(grep -aho '[a-z.]*/OneCollector/1.0' env/lib/python3*/site-packages/onnxruntime/capi/*.so | sort -u | tail -1)
echo "an address in the library: ${address:-none}"
if grep -q deviceid <<<"$plain" && [ -z "$off" ] && [ -n "$address" ]; then
  echo "as described"
else
  echo "CHANGED"
  exit 1
fi
