"""Write the page docs/api.md from the docstrings: ``python -m tools.api_page > docs/api.md``."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator
from importlib import import_module
from textwrap import dedent
from types import ModuleType

from pydantic import BaseModel

import cleargs

INTRODUCTION = """\
# The library

`import cleargs as cg` gives programs the functions of the command line. The import is fast: modules load on
first use. More scripts are in `examples/`.

```python
import cleargs as cg

run = cg.run("walk.mp4", quality="draft", progress=print)  # makes the folder walk, as `cleargs run walk.mp4`
print(run["rva"].table("frames").select(["name", "role", "weight"]))

scene = run.scene()  # Gaussians and rendering options
capture = cg.open_prepared(run["ingest"])  # frames, cameras, sparse points
camera = next(iter(capture.cameras().values()))  # of the first frame with a pose
image = cg.render_view(scene, camera).image  # [H, W, 3]

cg.export(run, "walk-z-up.ply", up="z")  # for Blender
cg.film(run, "walk-film.mp4", seconds=6)  # along the path of the capture

splats = scene.to_gsplat()  # arguments of gsplat.rasterization
capture.to_nerfstudio("walk-data")  # for nerfstudio, gsplat, Brush and others
dataset = capture.dataset()  # for your own training in torch
```

A synthetic capture has sharp images of the truth. After `cleargs demo`:

```python
demo = cg.open_run("demo/run")
print(cg.evaluate_scene(demo, "demo/capture/truth/observed").means)
```

This page is made from the source: `python -m tools.api_page > docs/api.md`.
"""

RETURNED = (
    "cleargs.splat.training.Trained",
    "cleargs.splat.types.Render",
    "cleargs.scene.viewer.Deblurred",
    "cleargs.evaluate.eval_report.Evaluation",
    "cleargs.evaluate.config.EvalOptions",
    "cleargs.capture.tables.Frame",
    "cleargs.capture.tables.Points",
    "cleargs.splat.views.ViewDataset",
    "cleargs.render.export.ExportOptions",
    "cleargs.render.shots.ShotOptions",
)
"""Types of arguments and results that are not in ``cleargs.__all__``."""


def page() -> str:
    """Return the page, with names in the order of ``cleargs.__all__``."""
    sections = [section(name) for name in cleargs.__all__]
    returned = [section(name.rpartition(".")[2], import_module(name.rpartition(".")[0])) for name in RETURNED]
    return "\n".join([INTRODUCTION, *sections, "# Types of arguments and results\n", *returned])


def section(name: str, home: ModuleType = cleargs) -> str:
    """Return heading, signature and docstring of a name; for a class, also its fields and methods."""
    found = getattr(home, name)
    source = inspect.getsource(found).splitlines()
    node = ast.parse("\n".join(source)).body[0]
    lines = [f"## {name}", "", *_text(found), ""]
    if isinstance(node, ast.FunctionDef):
        lines[2:2] = _code([_signature(node, source)])
    elif issubclass(found, BaseModel) and home is cleargs:
        lines += ["Its fields are settings: [settings.md](settings.md).", ""]
    elif issubclass(found, BaseModel):
        lines += [
            f"* `{field}`: {facts.description or ''}".rstrip(": ")
            for field, facts in found.model_fields.items()
        ]
        lines.append("")
    elif isinstance(node, ast.ClassDef):
        fields = [item for item in node.body if isinstance(item, ast.AnnAssign)]
        if fields:
            lines += _code([source[item.lineno - 1].strip() for item in fields])
        for item in _public(node):
            method = inspect.getattr_static(found, item.name)
            signature = item.name if isinstance(method, property) else _signature(item, source)
            lines += [*_code([signature]), *_text(getattr(found, item.name)), ""]
    return "\n".join(lines)


def _public(node: ast.ClassDef) -> Iterator[ast.FunctionDef]:
    for item in node.body:
        if isinstance(item, ast.FunctionDef) and (item.name == "__getitem__" or item.name[0] != "_"):
            yield item


def _signature(node: ast.FunctionDef, source: list[str]) -> str:
    """Return the signature as written in ``source``, without ``self``."""
    lines = source[node.lineno - 1 : node.body[0].lineno - 1]
    text = "\n".join(line.removeprefix(" " * node.col_offset) for line in lines)
    text = re.sub(r"\((\n?\s*)(self|cls)(, |,\s*\n\s*)?", r"(\1", text, count=1)
    return text.removeprefix("def ").removesuffix(":")


def _code(lines: list[str]) -> list[str]:
    return ["```python", *lines, "```", ""]


def _text(found: object) -> list[str]:
    """Return a docstring in Markdown: arguments and errors as lists, and the example as code."""
    text = (inspect.getdoc(found) or "").replace("``", "`")
    text, *sections = re.split(r"^(Args|Returns|Raises|Example):\n", text, flags=re.MULTILINE)
    parts = [text.rstrip()]
    for title, indented in zip(sections[::2], sections[1::2], strict=True):
        body = dedent(indented).strip()
        if title == "Example":
            body = f"```python\n{body}\n```"
        elif title != "Returns":
            body = re.sub(r"^(\w+):", r"* `\1`:", body, flags=re.MULTILINE)
        parts += [f"**{title}**", body]
    return "\n\n".join(parts).splitlines()


if __name__ == "__main__":
    print(page(), end="")
