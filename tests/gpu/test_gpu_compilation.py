"""Every GPU kernel compiles to machine code without a GPU. The rasteriser spills no registers."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).parent
KERNELS = FOLDER.parent.parent / "cleargs" / "splat" / "kernels" / "cuda"


def launched_kernels() -> set[str]:
    """Return the names that the package launches: ``name[grid](...)`` in its sources."""
    launches = re.compile(r"(\w+)\[(?:grid|\()")
    text = "\n".join(source.read_text(encoding="utf-8") for source in KERNELS.glob("*.py"))
    defined = set(re.findall(r"@triton\.jit[^\n]*\ndef (\w+)\(", text))
    return defined & set(launches.findall(text))


def test_every_kernel_compiles_for_a_gpu() -> None:
    # In a separate process: in this one Triton may be in interpreter mode, which cannot compile.
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    found = subprocess.run(
        [sys.executable, str(FOLDER / "compile_kernels.py")],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stderr[-2000:]
    rows = [line.strip("| ").split(" | ") for line in found.stdout.splitlines()[3:]]
    assert {row[0].split()[0] for row in rows} == launched_kernels()
    # The rasteriser takes most of the time. It must keep its registers, except a few bytes of an index.
    assert all(int(stack) <= 16 for name, _, stack, _ in rows if name.split()[0] in ("forward", "backward"))
