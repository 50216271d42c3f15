"""Imports point downwards: to the own package or to lower layers. No import cycle exists."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).parents[1]

LAYERS: tuple[tuple[str, ...], ...] = (
    ("cleargs",),  # root modules
    ("cleargs.media",),
    ("cleargs.capture", "cleargs.models", "cleargs.splat"),
    ("cleargs.formation", "cleargs.rva"),
    ("cleargs.scene",),
    ("cleargs.rivr", "cleargs.evaluate", "cleargs.synth"),
    ("cleargs.pipeline",),
    ("cleargs.handover",),
    ("cleargs.run_results",),  # reads the results of a finished run
    ("cleargs.report", "cleargs.render"),
    ("cleargs.api_scenes", "cleargs.api_images"),
    ("cleargs.api",),
    ("cleargs.stages", "cleargs.workflows"),
    ("cleargs.batch",),
    ("cleargs.cli",),
    ("cleargs.__main__",),
)
"""Packages from the bottom up. A module belongs to the longest name that it starts with."""

PIPELINE = "cleargs.pipeline"
"""The package that knows stages only by a protocol, so it imports only root modules."""


def modules() -> dict[str, Path]:
    """Dotted name -> file of every module that is installed."""
    found = {}
    for package, folder in (("cleargs", ROOT / "cleargs"), ("cleargs.stages", ROOT / "stages")):
        for path in sorted(folder.rglob("*.py")):
            parts = path.relative_to(folder).with_suffix("").parts
            parts = parts[:-1] if parts[-1] == "__init__" else parts
            found[".".join((package, *parts))] = path
    return found


def imports(module: str, text: str, known: Collection[str]) -> set[str]:
    """Modules of ClearGS that ``module`` imports, also inside functions, for type checking and relatively."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = module.split(".")[: -node.level] if node.level else []
            source = ".".join([*above, *([node.module] if node.module else [])])
            for alias in node.names:
                inner = f"{source}.{alias.name}"
                names.add(inner if inner in known else source)
    return names & set(known)


def package_of(module: str) -> str:
    """The package of `LAYERS` that holds a module."""
    packages = [name for layer in LAYERS for name in layer]
    return max((name for name in packages if f"{module}.".startswith(f"{name}.")), key=len)


def upward(graph: Mapping[str, set[str]]) -> Iterator[str]:
    """One line for each import that does not point to the own package or to a lower layer."""
    level = {name: number for number, layer in enumerate(LAYERS) for name in layer}
    for module, targets in sorted(graph.items()):
        for target in sorted(targets):
            here, there = package_of(module), package_of(target)
            into_domain = here == PIPELINE and there not in (PIPELINE, "cleargs")
            if here != there and (level[there] >= level[here] or into_domain):
                yield f"{module} imports {target}"


def cycles(graph: Mapping[str, set[str]]) -> list[list[str]]:
    """Groups of modules that import each other (strongly connected components of more than one module)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(module: str) -> None:
        index[module] = low[module] = len(index)
        stack.append(module)
        for target in graph[module]:
            if target not in index:
                visit(target)
                low[module] = min(low[module], low[target])
            elif target in stack:
                low[module] = min(low[module], index[target])
        if low[module] == index[module]:
            group = []
            while not group or group[-1] != module:
                group.append(stack.pop())
            if len(group) > 1:
                found.append(sorted(group))

    for module in graph:
        if module not in index:
            visit(module)
    return found


def graph() -> dict[str, set[str]]:
    """Module -> modules that it imports."""
    known = modules()
    return {name: imports(name, path.read_text("utf-8"), known) - {name} for name, path in known.items()}


def test_relative_imports_are_seen() -> None:
    known = ("cleargs.stages", "cleargs.stages.cost", "cleargs.stages.g0", "cleargs.errors")
    text = "from .cost import expected\nfrom . import cost\nfrom ..errors import StoreError"
    assert imports("cleargs.stages.g0", text, known) == {"cleargs.stages.cost", "cleargs.errors"}


def test_imports_point_downwards() -> None:
    assert not list(upward(graph()))


def test_no_import_cycle() -> None:
    assert not cycles(graph())


def test_no_module_imports_more_than_twenty_others() -> None:
    assert {module: len(targets) for module, targets in graph().items() if len(targets) > 20} == {}


def test_a_cycle_is_named() -> None:
    """The checks find a cycle of three modules, and an import from a higher layer."""
    circle = {"cleargs.splat.a": {"cleargs.splat.b"}, "cleargs.splat.b": {"cleargs.splat.c"}}
    circle |= {"cleargs.splat.c": {"cleargs.splat.a"}, "cleargs.media.d": {"cleargs.splat.a"}}
    assert cycles(circle) == [["cleargs.splat.a", "cleargs.splat.b", "cleargs.splat.c"]]
    assert list(upward(circle)) == ["cleargs.media.d imports cleargs.splat.a"]


def test_the_pipeline_loads_without_the_domain() -> None:
    """Importing the runner imports neither torch nor a stage."""
    wanted = "[name for name in ('torch', 'cleargs.splat') if name in sys.modules]"
    code = f"import sys, cleargs.pipeline.runner; print(*{wanted})"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert not loaded.split()
