"""Find phrases that slow readers down, and name the plain form of each.

The patterns are in ``prose.toml``. The program searches docstrings, comments, messages, help and templates.
It searches pages only in paths that are given. It skips code in backquotes and heads of questions. ::

    python -m tools.prose                    all code
    python -m tools.prose cleargs/splat      one package
    python -m tools.prose docs README.md     pages
    python -m tools.prose --count            finds per pattern and per folder
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import sys
import tokenize
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

PATTERNS = Path(__file__).with_suffix(".toml")

CODE = (
    ".ci/run",
    "Makefile",
    "benchmarks",
    "cleargs",
    "examples",
    "pyproject.toml",
    "stages",
    "tests",
    "tools",
    "workflows",
)
"""Paths that are checked where none are given."""

VENDORED = "cleargs/report/static/viewer"
"""A folder with other people's code, which is not checked."""


@dataclass(frozen=True)
class Pattern:
    """An entry of ``prose.toml``."""

    name: str
    find: re.Pattern[str]
    plain: str
    bad: str
    good: str


@dataclass(frozen=True)
class Passage:
    """A docstring, comment, message or page with the line ends of its file; quotes and code are blanked."""

    line: int
    text: str


@dataclass(frozen=True)
class Find:
    """A place where a pattern matches."""

    path: Path
    line: int
    words: str
    pattern: Pattern

    def __str__(self) -> str:
        return f'{self.path}:{self.line}: "{self.words}" -> {self.pattern.plain}'


def load_patterns(path: Path = PATTERNS) -> list[Pattern]:
    """Read the table of patterns.

    An entry has a regular expression, ``find``, in which a space matches any white space. Or it has a word,
    ``head``, which may open a question but no other sentence.
    """
    patterns = []
    for name, entry in tomllib.loads(path.read_text(encoding="utf-8")).items():
        find = entry["find"] if "find" in entry else _opening(entry["head"])
        compiled = re.compile(find.replace(" ", r"\s+"))
        patterns.append(Pattern(name, compiled, entry["plain"], entry["bad"], entry["good"]))
    return patterns


def _opening(word: str) -> str:
    """Return an expression for ``word`` and three words after it at the head of a sentence."""
    begin = r"\A(?:[\s-]*|[rf]*[\"']+)"
    return rf"(?:{begin}{word}|\b{word.capitalize()})\b(?![^.!|<>]*\?)(?: [\w-]+){{0,3}}"


def search(path: Path, passages: Iterable[Passage], patterns: Sequence[Pattern]) -> Iterator[Find]:
    """Yield the finds in the passages of a file, in the order of the patterns within a passage."""
    for passage in passages:
        for pattern in patterns:
            for match in pattern.find.finditer(passage.text):
                words = match.group()
                start = match.start() + len(words) - len(words.lstrip())
                line = passage.line + passage.text.count("\n", 0, start)
                yield Find(path, line, " ".join(words.split()), pattern)


def python_passages(source: str, messages: bool = True) -> Iterator[Passage]:
    """Yield the docstrings and comments of a module and, with ``messages``, its strings of several words."""
    rows = source.encode().split(b"\n")
    for node in _strings(ast.parse(source)):
        if isinstance(node, ast.Expr):
            yield _string_passage(rows, node)
        elif messages:
            passage = _string_passage(rows, node)
            if " " in passage.text.strip():
                yield passage
    comments = (
        (token.start[0], token.string, token.line.lstrip().startswith("#"))
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    )
    yield from _joined(comments)


def _strings(node: ast.AST) -> Iterator[ast.expr | ast.Expr]:
    """Yield the strings below ``node``, and docstrings as statements."""
    for child in ast.iter_child_nodes(node):
        value = child.value if isinstance(child, ast.Expr) else child
        if isinstance(value, ast.JoinedStr) or (
            isinstance(value, ast.Constant) and isinstance(value.value, str)
        ):
            assert isinstance(child, ast.expr | ast.Expr)
            yield child
        else:
            yield from _strings(child)


def _string_passage(rows: Sequence[bytes], node: ast.expr | ast.Expr) -> Passage:
    assert node.end_lineno is not None and node.end_col_offset is not None
    part = list(rows[node.lineno - 1 : node.end_lineno])
    part[-1] = part[-1][: node.end_col_offset]
    part[0] = part[0][node.col_offset :]
    text = b"\n".join(part).decode()
    quotes = r"\A[rRuU]*[\"']+" if isinstance(node, ast.Expr) else r"\n\s*[rfRF]*[\"']+"
    for expression in (quotes, r"(?m)[\"']+$", r"\\n"):
        text = _masked(expression, text)
    return Passage(node.lineno, _masked(r"\{[^{}]*\}", _masked(CODE_SPAN, text, "_"), "_"))


def comment_passages(source: str) -> Iterator[Passage]:
    """Yield the comments of a file whose comments begin with ``#``."""
    found = ((number, re.search(r"(?:^|\s)#.*", row)) for number, row in enumerate(source.split("\n"), 1))
    yield from _joined(
        (number, match.group().strip(), not match.string[: match.start()].strip())
        for number, match in found
        if match
    )


def _joined(comments: Iterable[tuple[int, str, bool]]) -> Iterator[Passage]:
    """Yield one passage per block of comments, given as (line number, text, alone on its line)."""
    block: list[str] = []
    begin = 0
    for number, text, alone in comments:
        if block and not (alone and number == begin + len(block)):
            yield Passage(begin, "\n".join(block))
            block = []
        if not block:
            begin = number
        block.append(_masked(CODE_SPAN, text.replace("#", " "), "_"))
        if not alone:
            yield Passage(begin, "\n".join(block))
            block = []
    if block:
        yield Passage(begin, "\n".join(block))


def page_passages(source: str) -> Iterator[Passage]:
    """Yield a page of Markdown as one passage, without its code blocks, code, links' targets and comments."""
    for expression in (r"(?ms)^( *)```.*?^\1```", r"(?s)<!--.*?-->", CODE_SPAN, r"\]\([^)]*\)"):
        source = _masked(expression, source, "_")
    yield Passage(1, source)


def template_passages(source: str) -> Iterator[Passage]:
    """Yield a template or script of the report as one passage, without Jinja's code and inserted values."""
    for expression in (r"(?s)\{\{.*?\}\}", r"(?s)\{%.*?%\}", r"\$\{[^{}]*\}"):
        source = _masked(expression, source, "_")
    yield Passage(1, source)


CODE_SPAN = r"`+[^`]+`+"


def _masked(expression: str, text: str, fill: str = " ") -> str:
    """Replace each character of the matches, except line ends, by ``fill``."""
    return re.sub(expression, lambda match: re.sub(r"[^\n]", fill, match.group()), text)


def passages(path: Path) -> Iterator[Passage]:
    """Yield the prose in a file; nothing for a kind of file without prose."""
    if path.suffix in (".py", ".pyi"):
        yield from python_passages(path.read_text(encoding="utf-8"), messages="tests" not in path.parts)
    elif reader := READERS.get(path.suffix or path.name):
        yield from reader(path.read_text(encoding="utf-8"))


READERS: dict[str, Callable[[str], Iterator[Passage]]] = {
    ".md": page_passages,
    ".jinja": template_passages,
    ".html": template_passages,
    ".js": template_passages,
    ".toml": comment_passages,
    ".yaml": comment_passages,
    ".yml": comment_passages,
    "Makefile": comment_passages,
    "Snakefile": comment_passages,
    "run": comment_passages,
}
"""Suffix or name of a file -> its reader; `passages` reads Python."""


def files(paths: Iterable[str | Path]) -> Iterator[Path]:
    """Yield the files at ``paths`` and in folders below them, in order; no hidden and no vendored ones."""
    for name in paths:
        path = Path(name)
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            hidden = any(part.startswith((".", "__pycache__")) for part in file.relative_to(path).parts)
            if file.is_file() and not hidden and VENDORED not in file.as_posix():
                yield file


def table(finds: Sequence[Find], patterns: Sequence[Pattern]) -> str:
    """Return the number of finds per pattern, in code and in pages, and per folder."""
    per_pattern = Counter((find.pattern.name, find.path.suffix == ".md") for find in finds)
    per_folder = Counter(find.path.parent.as_posix() for find in finds)
    lines = [f"{'pattern':40} {'code':>6} {'docs':>6}"]
    for pattern in patterns:
        code, docs = per_pattern[pattern.name, False], per_pattern[pattern.name, True]
        lines.append(f"{pattern.name:40} {code:6} {docs:6}")
    lines += ["", f"{'folder':40} {'finds':>6}"]
    lines += [f"{folder:40} {number:6}" for folder, number in sorted(per_folder.items())]
    lines.append(f"{'all':40} {len(finds):6}")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the finds or their numbers. Return 1 if there are any, else 0."""
    parser = argparse.ArgumentParser(prog="python -m tools.prose", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("paths", nargs="*", help="files and folders (default: all code, without its pages)")
    parser.add_argument("--count", action="store_true", help="print numbers of finds, not the finds")
    options = parser.parse_args(arguments)
    patterns = load_patterns()
    paths = options.paths or [path for path in files(CODE) if path.suffix != ".md"]
    finds = [find for path in files(paths) for find in search(path, passages(path), patterns)]
    if options.count:
        print(table(finds, patterns))
    else:
        print("\n".join(map(str, finds)) or "no finds")
    return 1 if finds else 0


if __name__ == "__main__":
    sys.exit(main())
