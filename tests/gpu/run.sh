#!/usr/bin/env bash
# Everything that needs a GPU, from the repository's root:
#
#     tests/gpu/run.sh OUT [RUN]
#
# Writes into OUT: versions.txt; selftest.log (the self-test that users run); tests.log and agreement.log (the GPU tests
# against the oracle, and against the CPU's kernels); sanitizer.log; bench/ (`python -m benchmarks splat --device cuda`);
# and, if RUN is given, g0/ (the first scene at full size: its time and PSNR are in stages.json). RUN is a folder with the
# finished ingest/ and rva/ of a capture, made on another machine: see splat_stages.py and pack_run.py. A step that fails is
# named at the end; the others run.
#
# STEPS chooses among "selftest tests agreement sanitizer bench g0" (default: all), for machines that are rented by the minute:
# each step ends within ten. QUICK=1 makes the bench and the training small, to try the script. PYTHON names the interpreter
# (python3). Triton compiles during the first step, which takes a minute longer.
#
# Needs PyTorch with CUDA, Triton, pytest, hypothesis, numba, pydantic, pyarrow, scipy, OpenCV, safetensors, click, rich
# and tomli-w; neither pycolmap nor OpenImageIO. The self-test needs PyTorch, Triton, numba and SciPy only. gsplat is timed in turn
# with our kernels if it can be imported: it is built for this machine's architecture only, while the tests run.
set -uo pipefail
cd "$(dirname "$0")/../.."
out="$(mkdir -p "${1:?usage: tests/gpu/run.sh OUT [RUN]}" && cd "$1" && pwd)"
run="${2:+$(realpath "$2")}"
steps=" ${STEPS:-selftest tests agreement sanitizer bench g0} "
python="${PYTHON:-python3}"
unset TRITON_INTERPRET
export PYTHONUNBUFFERED=1
# Nothing needs to be installed: in links to the checkout, the folder `stages` is the package `cleargs.stages`.
links="$(mktemp -d)"
trap 'rm -rf "$links"' EXIT
mkdir "$links/cleargs"
ln -s "$PWD"/cleargs/* "$PWD/stages" "$PWD/workflows" "$links/cleargs"
ln -s "$PWD"/{benchmarks,examples,pyproject.toml,stages,tests,tools} "$links"
cd "$links"
export PYTHONPATH="$links${PYTHONPATH:+:$PYTHONPATH}"
failed=()

wanted() { [[ "$steps" == *" $1 "* ]]; }

step() {  # step NAME SECONDS COMMAND...: run within a time limit, keep the log, remember a failure
  local name="$1" limit="$2"
  shift 2
  wanted "$name" || return 0
  echo "== $name"
  timeout "$limit" "$@" >"$out/$name.log" 2>&1 || failed+=("$name")
  tail -n 15 "$out/$name.log"
}

{
  nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv
  "$python" -c 'import torch, triton, sys; print(sys.version); print(torch.__version__, triton.__version__)
print(torch.cuda.get_device_name(), torch.cuda.get_device_capability())'
} >"$out/versions.txt" 2>&1
cat "$out/versions.txt"
if ! "$python" -c 'import torch, triton; raise SystemExit(not torch.cuda.is_available())'; then
  echo "no GPU that PyTorch and Triton can use: nothing was run"
  exit 1
fi

gsplat_build=
if wanted bench; then
  TORCH_CUDA_ARCH_LIST="$("$python" -c 'import torch; print("%d.%d" % torch.cuda.get_device_capability())')"
  export TORCH_CUDA_ARCH_LIST MAX_JOBS="${MAX_JOBS:-8}"
  timeout 540 "$python" -c 'import gsplat.cuda._backend' >"$out/gsplat-build.log" 2>&1 &
  gsplat_build=$!
fi

step selftest 400 "$python" -m cleargs.gpu
step tests 400 "$python" -m pytest -m gpu tests/gpu tests/splat tests/formation --deselect tests/gpu/test_gpu_against_cpu.py
step agreement 300 "$python" -m pytest tests/gpu/test_gpu_against_cpu.py
# Under memcheck: forward and backward pass, several chunks a tile, pixels that stop; the frame warp beyond borders.
if ! wanted sanitizer; then
  :
elif command -v compute-sanitizer >/dev/null; then
  step sanitizer 300 compute-sanitizer --tool memcheck --error-exitcode 9 \
    "$python" -m pytest -m gpu tests/splat/test_rasteriser.py tests/formation/test_warp.py \
    -k "ordinary or chunks or near_plane or hard_cases"
else
  echo "compute-sanitizer is not installed" | tee "$out/sanitizer.log"
  failed+=(sanitizer)
fi

if [ -n "$gsplat_build" ]; then
  wait "$gsplat_build" || echo "gsplat was not built: see gsplat-build.log"
fi
step bench 560 "$python" -m benchmarks splat --device cuda -o "$out/bench" ${QUICK:+--quick}
if [ -n "$run" ]; then
  step g0 560 "$python" tests/gpu/splat_stages.py "$run" "$out/g0" ${QUICK:+--steps 200 --budget 20000}
elif wanted g0; then
  echo "== g0: not run, no prepared RUN was given"
fi

if [ "${#failed[@]}" -gt 0 ]; then
  echo "failed: ${failed[*]}"
  exit 1
fi
