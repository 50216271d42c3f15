"""Packages, versions and dependencies of an installation."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import cleargs

ROOT = Path(__file__).parents[1]


def test_every_package_is_listed() -> None:
    """setuptools cannot find packages through ``package-dir``, so they are listed by hand."""
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    own = [path.parent.relative_to(ROOT) for path in (ROOT / "cleargs").rglob("__init__.py")]
    assert sorted(listed) == sorted(
        [".".join(p.parts) for p in own] + ["cleargs.stages", "cleargs.workflows"]
    )


CHECKOUT_ALONE = ("benchmarks", "tools")
"""Packages of the checkout that the wheel leaves out."""


def test_wheel_imports_nothing_of_the_checkout() -> None:
    for path in [*(ROOT / "cleargs").rglob("*.py"), *(ROOT / "stages").rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            assert not [name for name in names if name.split(".")[0] in CHECKOUT_ALONE], path


def test_the_version_is_the_same_everywhere() -> None:
    """``cleargs.__version__``, the metadata of the installation, the citation and the changelog agree."""
    assert version("cleargs") == cleargs.__version__
    cited = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert cited is not None and cited[1] == cleargs.__version__
    assert f"## [{cleargs.__version__}]" in (ROOT / "CHANGELOG.md").read_text()


def test_every_dependency_is_pinned() -> None:
    """The lock lists all packages of an installation, including indirect dependencies, with digests."""
    lock = (ROOT / "requirements.lock").read_text()
    pins = re.findall(r"^(\S+)==[^\\\n]*((?: \\\n    --hash=sha256:[0-9a-f]{64})+)$", lock, re.MULTILINE)
    assert len(pins) == sum(bool(line) and line[0] not in "# " for line in lock.splitlines())
    locked = {canonicalize_name(name) for name, _ in pins}
    missing = needed("cleargs", ("test", "dev", "docs", "browser")) - locked
    assert {name for name in missing if not name.startswith(LEFT_OPEN)} == set()


def test_the_versions_here_are_those_of_the_lock() -> None:
    """CI tests the versions that the lock installs."""
    shared = (ROOT / "requirements.lock").read_text().split("\n## cuda ")[0]
    locked = dict(re.findall(r"^(\S+)==([^\s;]+)", shared, re.MULTILINE))
    here = {name: version(name) for name in needed("cleargs", ("test",)) if name in locked}
    assert len(here) > 40 and here == {name: locked[name] for name in here}


def test_the_container_has_the_steps_of_the_page() -> None:
    """The commands of the Dockerfile are those of docs/install.md."""
    page = (ROOT / "docs" / "install.md").read_text().partition("## Your own environment")[2]
    commands = re.search(r"```sh\n(.*?)```", page, re.DOTALL)
    steps = re.findall(r"^RUN (.+)$", (ROOT / "Dockerfile").read_text(), re.MULTILINE)
    assert commands is not None and len(steps) >= 2 and steps == commands[1].splitlines()


LEFT_OPEN = ("pip", "torch", "nvidia-", "cuda-", "triton")
"""Packages that the lock leaves out: pip, torch (see constraints.txt) and its dependencies."""


def needed(distribution: str, extras: tuple[str, ...] = ()) -> set[str]:
    """Normalised names of the direct and indirect dependencies of ``distribution`` on this platform."""
    found: set[str] = set()
    waiting = [(distribution, extras)]
    seen = set()
    while waiting:
        name, wanted = waiting.pop()
        if (name, wanted) in seen:
            continue
        seen.add((name, wanted))
        try:
            listed = requires(name) or []
        except PackageNotFoundError:  # an extra that is not installed
            continue
        for text in listed:
            requirement = Requirement(text)
            marker = requirement.marker
            if marker is None or any(marker.evaluate({"extra": extra}) for extra in ("", *wanted)):
                found.add(canonicalize_name(requirement.name))
                waiting.append((requirement.name, tuple(sorted(requirement.extras))))
    return found - {"cleargs"}


def test_the_splatting_core_needs_no_capture_libraries() -> None:
    """Machines that only train have neither pycolmap nor OpenImageIO."""
    code = (
        "import sys; sys.modules.update({'pycolmap': None, 'OpenImageIO': None});"
        "import cleargs.splat.training, cleargs.splat.render, cleargs.splat.ply, cleargs.splat.backend"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_command_line_starts_without_heavy_imports() -> None:
    code = (
        "import sys, cleargs.cli.main, cleargs.stages, cleargs.cli.run;"
        "from importlib import import_module;"
        "[import_module('cleargs.stages.' + name) for name in cleargs.stages.STAGES];"
        "heavy = {'torch', 'numba', 'pycolmap', 'cv2', 'onnxruntime', 'OpenImageIO'};"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
