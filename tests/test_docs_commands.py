"""The commands in README and docs: all parse, and those of users run on a tiny video.

Each command of a shell block runs in its order on the page, except those in `NOT_RUN`, which has the reason.
"""

from __future__ import annotations

import importlib.util
import re
import shlex
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import click
import pytest

import cleargs as cg
from benchmarks.commands import benchmarks
from benchmarks.commands import invoke as invoke_benchmarks
from cleargs.cli.main import cli, invoke
from cleargs.media.encode import write_video
from cleargs.media.image import read_rgb, write_rgb
from cleargs.pipeline.config import load_config
from cleargs.pipeline.stages import installed
from cleargs.progress import SilentReporter
from cleargs.synth.path import FPS
from cleargs.synth.synthetic_capture import make_capture

ROOT = Path(__file__).parents[1]
USER_PAGES = (
    "README.md",
    *(f"docs/{name}.md" for name in ("first-run", "capture", "other-programs", "films", "viewers")),
    *(f"docs/{name}.md" for name in ("compare-your-method", "measuring", "rva", "report", "models")),
)
"""Pages whose commands run, in this order. README makes the run `walk` that the others use."""
_FILES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "benchmarks/README.md", "tools/README.md")]
_FILES += sorted((ROOT / "docs").rglob("*.md"))
PAGES = tuple(
    path.relative_to(ROOT).as_posix()
    for path in _FILES
    if not path.is_relative_to(ROOT / "docs/experiments/results-older")
    and path.name != "results-older.md"  # has the commands of the versions that it measured
)

PAGES_NOT_RUN = {
    "docs/cluster.md": "needs a cluster, or several captures; tests/batch runs such sheets",
    "docs/datasets.md": "needs data sets of others",
    "docs/developers.md": "changes files of the checkout",
    "docs/gpu.md": "needs a GPU",
    "docs/install.md": "installs packages; make test-package does so",
    "docs/motion.md": "trains for minutes",
    "docs/speed.md": "measures for minutes",
}
"""Page with commands that are only parsed -> reason. The experiments need captures and hours."""

NOT_RUN = {
    "cleargs demo": "runs for minutes; make test-package runs a smaller one",
    "cleargs watch": "serves until Ctrl-C",
    "cleargs models install": "needs a network",
    "--recipe paper": "needs networks that are not shipped",
    "python -m benchmarks compare": "trains for minutes; tests/benchmarks runs it on a tiny capture",
    "python -m benchmarks evidence": "trains for hours; tests/benchmarks runs it on tiny captures",
    "python -m benchmarks real": "needs captures of others; tests/benchmarks runs it on a tiny one",
    "python -m tools.convert_models": "needs checkpoints of others; make test-convert tests it",
}
"""Part of a command on one of `USER_PAGES` -> reason why it does not run here."""
OTHER_PROGRAMS = frozenset(
    {
        "brew",
        "cat",
        "cd",
        "docker",
        "export",
        "git",
        "pip",
        "pipx",
        "snakemake",
        "source",
        "sudo",
        "uv",
        "wsl",
    }
    | {"apt-get", "vllm"}
)
"""Programs of others. Their commands are not checked."""

TINY = {
    "run": "--steps 20 --set g0.min_points=300 --set g0.budget=400 --set rivr.distil.steps=5 "
    "--set consolidate.distil.steps=5 --threads 1",
    "synth": "--frames 6 --size 96x54",
    "world": "--frames 6 --size 96x54",
    "render": "--seconds 0.2",
    "gc": "--yes",
}
"""Options that are appended to a command that runs, so that it takes seconds and asks nothing."""
PLACEHOLDERS = {"N": "1"}


@dataclass(frozen=True)
class Command:
    page: str
    words: tuple[str, ...]
    in_block: bool
    """False for a command within a sentence, which may leave arguments out."""

    def __str__(self) -> str:
        return f"{self.page}: {shlex.join(self.words)}"


def commands(page: str) -> Iterator[Command]:
    """Yield the commands in the shell blocks of a page, and our commands in backquotes."""
    text = (ROOT / page).read_text(encoding="utf-8")
    for block in re.findall(r"(?ms)^ *```sh\n(.*?)^ *```", text):
        block = re.sub(r"(?ms)<<'(\w+)'\n.*?^\1$", "", block).replace("\\\n", " ")
        for line in block.splitlines():
            for part in split_line(line):
                yield Command(page, part, True)
    prose = re.sub(r"(?ms)^ *```.*?^ *```", "", text)
    for span in re.findall(r"`((?:\S*/)?cleargs [^`]+|python -m (?:benchmarks|tools)[^`]+)`", prose):
        yield from (Command(page, part, False) for part in split_line(span.replace("\n", " ")))


def split_line(line: str) -> Iterator[tuple[str, ...]]:
    """Yield the commands of a shell line, without comments, redirections and assignments of variables."""
    lexer = shlex.shlex(line, posix=True, punctuation_chars=";&|<>")
    lexer.whitespace_split = True
    part: list[str] = []
    for word in [*lexer, ";"]:
        if set(word) <= set(";&"):
            redirected = [k for k, asked in enumerate(part) if set(asked) <= set("<>")]
            part = part[: redirected[0]] if redirected else part
            while part and re.fullmatch(r"\w+=.*", part[0]):
                part = part[1:]
            if part:
                yield tuple(part)
            part = []
        else:
            part.append(word)


def program_of(words: tuple[str, ...]) -> tuple[str, tuple[str, ...]]:
    """Return the name of a program without its folder, or `python -m MODULE`, and its arguments."""
    name = words[0].rpartition("/")[2]
    if name == "python" and words[1:2] == ("-m",):
        return f"python -m {words[2]}", words[3:]
    return name, words[1:]


def problem(command: Command) -> str | None:
    """Return what is wrong with a command, or None."""
    program, arguments = program_of(command.words)
    if program == "cleargs":
        return problem_of_click(cli, arguments, command.in_block)
    if program == "python -m benchmarks":
        return problem_of_click(benchmarks, arguments, command.in_block)
    if program.startswith("python -m tools"):
        spec = importlib.util.find_spec(program.removeprefix("python -m "))
        return None if spec else "no such module"
    if program == "make":
        targets = re.findall(r"(?m)^([\w-]+):", (ROOT / "Makefile").read_text())
        return None if set(arguments) <= set(targets) else "no such target"
    if program in ("python", "run", "run.sh"):
        file = ROOT / (arguments[0] if program == "python" else command.words[0])
        return None if file.is_file() or arguments[:1] == ("-",) else "no such file"
    known = program in OTHER_PROGRAMS or program.startswith(("python -m pytest", "$"))
    return None if known else "unknown program"


def problem_of_click(command: click.Command, arguments: tuple[str, ...], whole: bool) -> str | None:
    """Return what is wrong with the arguments of a command; a part of one may lack arguments."""
    context = click.Context(command, resilient_parsing=True)
    parser = command.make_parser(context)
    parser.allow_interspersed_args = not isinstance(command, click.Group)
    try:
        values, rest, _ = parser.parse_args(list(arguments))
    except click.UsageError as error:
        if not whole and "requires an argument" in error.format_message():
            return None
        return error.format_message()
    if isinstance(command, click.Group):
        if not rest:
            return None
        found = command.get_command(context, rest[0])
        return problem_of_click(found, tuple(rest[1:]), whole) if found else f"no command {rest[0]}"
    if rest and "..." not in rest:
        return f"too many arguments: {rest}"
    if values.get("quality") == "draft|standard|high":
        return None
    for parameter in command.params:
        given = values.get(parameter.name or "")
        value = given if isinstance(given, str) else None
        choices = parameter.type.choices if isinstance(parameter.type, click.Choice) else None
        if choices and value and not value.isupper() and not set(value.split("|")) <= set(choices):
            return f"{parameter.name}: {value}"
        missing = parameter.required and not (isinstance(given, str | tuple) and given)
        if whole and missing and isinstance(parameter, click.Argument) and values.get("help") is not True:
            return f"{parameter.name} is missing"
    return None


@pytest.mark.parametrize("page", PAGES)
def test_commands_name_existing_programs_and_options(page: str) -> None:
    found = {str(command): problem(command) for command in commands(page)}
    assert {text: what for text, what in found.items() if what} == {}


def test_every_page_runs_or_says_why_not() -> None:
    docs = {path.relative_to(ROOT).as_posix() for path in (ROOT / "docs").glob("*.md")}
    others = {page for page in docs if "\n```sh" in (ROOT / page).read_text(encoding="utf-8")} - set(
        USER_PAGES
    )
    assert others == set(PAGES_NOT_RUN)


def test_pages_have_commands() -> None:
    assert sum(1 for page in PAGES for _ in commands(page)) > 150


def test_wrong_commands_are_found() -> None:
    lines = ["cleargs rnu walk", "cleargs run walk --qualty draft", "cleargs export walk --for gimp"]
    lines += ["cleargs pack", "cleargs run a b c", "make tests", "python -m tools.absent", "python absent.py"]
    for line in [*lines, "bogus"]:
        (words,) = split_line(line)
        assert problem(Command("page", words, True)), line


def test_settings_in_commands_exist() -> None:
    lines = [command for page in PAGES for command in commands(page) if "--set" in command.words]
    assert len(lines) > 10
    for command in lines:
        words = command.words
        given = [words[place + 1] for place, word in enumerate(words[:-1]) if word == "--set"]
        known = [line for line in given if "=" in line and not re.search(r"=([A-Z]+|.*\.\.\.)$", line)]
        load_config(installed(), "default", tuple(known), 0)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a short video, and with the names that the pages use."""
    folder = tmp_path_factory.mktemp("docs")
    clip = folder / "clip"
    make_capture(clip, "sharp", frames=13, width=160, height=90, seed=3, reporter=SilentReporter())
    frames = [read_rgb(path) for path in sorted((clip / "images").iterdir())]
    write_video(folder / "walk.mp4", frames, FPS)
    return folder


def make_measured_run() -> None:
    """Make the run and the folders that docs/measuring.md names."""
    assert invoke(["run", "OUT", "-o", "RUN", "--holdout", "every:3", *shlex.split(TINY["run"])]) == 0
    shutil.copy("RUN/scene.ply", "SCENE.ply")
    shutil.copytree("OUT/truth/observed", "DIR")
    shutil.copytree("DIR/images", "OTHER")


def make_renders() -> None:
    """Make grey images in place of another method's renders."""
    Path("mine").mkdir()
    for path in Path("room/truth/novel/images").iterdir():
        write_rgb(Path("mine") / f"{path.stem}.png", read_rgb(path) // 2 + 64)


PREPARE: dict[str, Callable[[], None]] = {
    "--scene RUN/g0/scene.ply": make_measured_run,
    "--renders mine": make_renders,
}
"""Part of a command -> what its page takes as given, made before it runs."""


@pytest.mark.slow  # about a hundred seconds of one core: about fifty commands, with three small runs
def test_commands_of_the_pages_run(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)
    monkeypatch.setenv("CLEARGS_MODELS", str(place / "models"))
    prepared, made, failed = dict(PREPARE), set[str](), []
    for page in USER_PAGES:
        before = set(Path().iterdir())
        for command in commands(page):
            line = shlex.join(command.words)
            program, arguments = program_of(command.words)
            runs = {"cleargs": invoke, "python -m benchmarks": invoke_benchmarks}.get(program)
            if not command.in_block or runs is None or any(part in line for part in NOT_RUN):
                continue
            for part in [part for part in prepared if part in line]:
                prepared.pop(part)()
            words = [PLACEHOLDERS.get(word, word) for word in arguments]
            if not {"--frame", "--poses"} & set(words):
                words += shlex.split(TINY.get(words[0], ""))
            if code := runs(words):
                failed.append(f"{page}: {line}: exit code {code}")
        new = {path for path in set(Path().iterdir()) - before if path.is_file() and path.name != "SCENE.ply"}
        made |= {path.name for path in new if path.stat().st_size > 100}
        for path in new:
            path.unlink()  # the next page may use the same name
    assert failed == []
    assert made >= {
        "walk-web.spz",
        "walk-film.mp4",
        "walk.html",
        "walk.zip",
        "turn.mp4",
        "still.png",
        "mine.json",
    }
    assert Path("walk/scene.ply").is_file() and Path("walk/report.html").is_file() and not prepared


@pytest.mark.slow  # about 15 s alone: the run `walk`, which the commands of the pages also make
def test_the_first_example_of_the_library_runs(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only smaller: 20 steps, and a film of 0.2 s."""
    monkeypatch.chdir(place)
    intro = (ROOT / "docs/api.md").read_text(encoding="utf-8").split("This page is made from")[0]
    first, second = re.findall(r"(?ms)^```python\n(.*?)^```", intro)
    size = {"frames": 6, "width": 96, "height": 54}
    make_capture(Path("demo/capture"), "mixed", **size, seed=0, reporter=SilentReporter())
    assert invoke(["run", "demo/capture", "-o", "demo/run", *shlex.split(TINY["run"])]) == 0
    tiny = {"g0.steps": 20, "g0.min_points": 300, "g0.budget": 400}
    tiny |= {f"{stage}.distil.steps": 5 for stage in ("rivr", "consolidate")}  # as in `TINY`
    for source in ("walk.mp4", "demo/capture"):
        code = first.replace('"walk.mp4"', f'"{source}"').replace("seconds=6", "seconds=0.2")
        code = code.replace('quality="draft"', f'quality="draft", set={tiny}')
        for name in ("walk-z-up.ply", "walk-film.mp4", "walk-data"):
            code = code.replace(f'"{name}"', f'"{source.partition("/")[0]}-{name}"')
        names: dict[str, object] = {}
        exec(code, names)
        assert getattr(names["image"], "ndim", 0) == 3
    exec(second, {"cg": cg})
    assert Path("walk.mp4-walk-film.mp4").stat().st_size > 100
