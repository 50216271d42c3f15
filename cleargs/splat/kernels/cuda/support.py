"""Requirements of the GPU back end, and the errors of a GPU."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from subprocess import CalledProcessError

import torch

from cleargs.errors import InputError, StageError
from cleargs.splat.kernels import memory


def on_gpu(device: torch.device) -> bool:
    """Return True if the GPU kernels serve tensors on ``device``. Every dispatch calls this function."""
    return device.type == "cuda"


def require(device: torch.device) -> None:
    """Raise InputError if the kernels cannot run on ``device``."""
    if importlib.util.find_spec("triton") is None:
        raise InputError(
            "the GPU kernels need Triton, which is not installed",
            hint="install it with pip install 'cleargs[cuda]', or use --device cpu",
        )
    if device.type == "cuda" and not torch.cuda.is_available():
        built = "" if torch.version.cuda else ": this PyTorch is built for the CPU only"
        raise InputError(
            f"PyTorch finds no usable CUDA device{built}",
            hint="install a CUDA build of PyTorch and the NVIDIA driver, or use --device cpu",
        )


def available_memory(device: torch.device) -> int:
    """Return the free bytes on ``device``, including those that torch has reserved but does not use."""
    if device.type != "cuda":  # tensors of the interpreter
        return memory.available_memory()
    free, _ = torch.cuda.mem_get_info(device)
    kept = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return int(free + kept)


@contextmanager
def memory_errors() -> Iterator[None]:
    """Turn an error about full GPU memory into a StageError that says what to change."""
    try:
        yield
    except torch.cuda.OutOfMemoryError as error:
        raise StageError(
            f"the GPU's memory is full: {str(error).splitlines()[0]}",
            hint="lower g0.budget, cache_mb or ingest.max_size and run again: the last checkpoint is kept",
        ) from error


def gpu_fault(error: BaseException | None) -> str | None:
    """Return in one line what the GPU, its driver or a library on it reported; None for any other error."""
    while error is not None:
        line = (str(error).strip().splitlines() or [""])[0]
        if isinstance(error, torch.cuda.OutOfMemoryError):
            return f"the GPU's memory is full: {line}"
        if "driver" in line and "too old" in line:
            return f"the NVIDIA driver is too old for this PyTorch (CUDA {torch.version.cuda})"
        if "no NVIDIA driver" in line:
            return "PyTorch finds no NVIDIA driver"
        # Triton compiles a small library in C when it first sees a GPU.
        if "find C compiler" in line:
            return "Triton needs a C compiler: install gcc or clang"
        if isinstance(error, CalledProcessError) and "cuda_utils" in line:
            return "Triton's C compiler failed: the headers of Python (python3-dev) may be missing"
        library = type(error).__module__.split(".")[0]
        from_cuda = "CUDA" in str(error) and (library == "onnxruntime" or isinstance(error, RuntimeError))
        if library == "triton" or from_cuda:
            return f"{type(error).__name__}: {line}"
        error = error.__cause__ or error.__context__
    return None
