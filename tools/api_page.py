"""Write the page docs/api.md from the docstrings: ``python -m tools.api_page > docs/api.md``."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator
from textwrap import dedent

from pydantic import BaseModel

import cleargs

INTRODUCTION = """\
# The library

`import cleargs as cg` gives programs the functions of the command line, {count} names in all. The import is
fast: modules load on first use, and training loads neither pycolmap nor OpenImageIO. Start from the scripts
in `examples/`.

This page is made from the source: `python -m tools.api_page > docs/api.md`.
"""


def page() -> str:
    """Return the page, with names in the order of ``cleargs.__all__``."""
    sections = (section(name) for name in cleargs.__all__)
    return "\n".join([INTRODUCTION.format(count=len(cleargs.__all__)), *sections])


def section(name: str) -> str:
    """Return heading, signature and docstring of one name; for a class, also its fields and methods."""
    found = getattr(cleargs, name)
    source = inspect.getsource(found).splitlines()
    node = ast.parse("\n".join(source)).body[0]
    lines = [f"## {name}", "", *_text(found), ""]
    if isinstance(node, ast.FunctionDef):
        lines[2:2] = _code([_signature(node, source)])
    elif issubclass(found, BaseModel):
        lines += ["Its fields are settings: [settings.md](settings.md).", ""]
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
