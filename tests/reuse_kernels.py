"""Let an installation use the kernels that this checkout compiled: `python tests/reuse_kernels.py PYTHON`.

Numba names a folder of its cache by the path of the source, and compares what the source contains. The folder
of the installed package becomes a link to that of the checkout. If a source differs, Numba compiles it.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from numba.core.caching import UserProvidedCacheLocator

from cleargs import kernel_cache
from cleargs.splat.kernels.cpu.jit import kernel_digest

CHECKOUT = Path(__file__).parents[1]
CACHES = {
    f"kernels-{kernel_digest()}": "cleargs/splat/kernels/cpu/__init__.py",
    "raycast": "cleargs/synth/raycast.py",
}


def main() -> None:
    """Make the links."""
    find = "import cleargs; print(cleargs.__path__[0])"
    told = subprocess.run([sys.argv[1], "-P", "-c", find], check=True, capture_output=True, text=True)
    installed = Path(told.stdout.strip()).parent
    for name, source in CACHES.items():
        ours, theirs = (
            UserProvidedCacheLocator.get_suitable_cache_subpath(str(root / source))
            for root in (CHECKOUT, installed)
        )
        folder = kernel_cache.cache_folder(name)
        (folder / ours).mkdir(exist_ok=True)
        if not (folder / theirs).exists():
            (folder / theirs).symlink_to(ours)


if __name__ == "__main__":
    main()
