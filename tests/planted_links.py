"""Plant links in a run folder, as a hostile sender could, and check that nothing outside is read or changed.

``python tests/planted_links.py --links 1000`` traces all commands to find every path that they open, list,
create, rename or delete. At each path it plants links of several kinds, one at a time. Then it gives the
commands again. Half of the links are in a toy run, which is computed again. The others are in a finished run
and in an unpacked pack, which are shown, exported, rendered, evaluated and packed.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, field
from io import StringIO
from itertools import islice
from pathlib import Path
from typing import Any, TypeAlias

sys.path += [str(Path(__file__).parent / name) for name in ("helpers", "pipeline", "report")]

import toy
from colmap_model import write_no_formation, write_sparse
from report_run import FinishedRun

from cleargs.cli.main import invoke
from cleargs.manifest import linked_manifest
from cleargs.pipeline.stages import Stages, installed

Commands: TypeAlias = tuple[tuple[str, ...], ...]

TOY_COMMANDS: Commands = (
    ("status", "RUN"),
    ("show", "RUN"),
    ("run", "CAPTURE", "-o", "RUN", "--no-report", "--set", "square.power=4", "--log", "RUN/all.log"),
    ("verify", "RUN"),
    ("run", "CAPTURE", "-o", "RUN", "--no-report", "--set", "square.power=2", "--force", "total"),
    ("gc", "RUN", "--checkpoints", "--yes"),
)

SCENE_COMMANDS: Commands = (
    ("show", "RUN", "--frame", "2", "-o", "OUT/frame.png", "--force"),
    ("export", "RUN", "-o", "OUT/a.ply", "--prune", "contribution:0.1", "--cameras", "--force"),
    ("render", "RUN", "-o", "OUT/a.png", "--frame", "2", "--side-by-side", "--force"),
    ("eval", "RUN", "--lpips", "none", "--scorers", "none", "--stage", "all"),
    ("pack", "RUN", "-o", "OUT/a.zip", "--force"),
    ("report", "RUN", "--single-file"),
    ("verify", "RUN"),
)

PACKED_COMMANDS: Commands = (
    ("status", "RUN"),
    ("show", "RUN", "--frame", "2"),
    ("export", "RUN", "-o", "OUT/a.ply", "--cameras", "--force"),
    ("render", "RUN", "-o", "OUT/a.png", "--frame", "2", "--force"),
    ("report", "RUN", "--single-file"),
    ("verify", "RUN"),
)

KINDS = (
    *("link", "relative link", "dangling link", "hard link", "link to the run", "FIFO"),
    *("link to a link", "link to the parent"),
)

NEW_EACH_TIME = re.compile(r"\.partial\.|\.rubbish-|\.link-[0-9a-f]{8}|\.carried|/dev/|\.at_work")
"""Names that nobody can foresee, or that are tested by themselves."""


@dataclass
class Trace:
    """Audit hook that notes every path below ``root`` that is used, and every use of ``outside``."""

    root: Path
    outside: Path
    used: set[Path] = field(default_factory=set)
    touched: set[str] = field(default_factory=set)
    on: bool = False

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.on or not (event == "open" or event.startswith(("os.", "shutil.", "sqlite3."))):
            return
        self.on = False
        try:
            for path in arguments[: 1 if event == "open" else 2]:
                if isinstance(path, str | bytes | os.PathLike):
                    self._note(event, os.fsdecode(path), arguments)
        finally:
            self.on = True

    def _note(self, event: str, path: str, arguments: tuple[Any, ...]) -> None:
        # A relative path may start from any of the open folders.
        for base in [Path("/")] if Path(path).is_absolute() else open_folders():
            place = Path(base, path)
            if self.root in place.parents:
                self.used.add(place.relative_to(self.root))
            flags = arguments[2] if event == "open" and len(arguments) > 2 else 0
            follows = event != "open" or not (isinstance(flags, int) and flags & os.O_NOFOLLOW)
            removes = event in (
                "os.remove",
                "os.rename",
                "os.symlink",
                "os.link",
            )  # they act on the link itself
            if follows and not removes and self.outside in Path(os.path.realpath(place)).parents:
                self.touched.add(f"{event} {place}")


def open_folders() -> list[Path]:
    """Return the paths of all open files and folders of this process."""
    found = []
    for descriptor in Path("/proc/self/fd").iterdir():
        with suppress(OSError):  # the descriptor of this listing
            found.append(descriptor.readlink())
    return [path for path in found if path.is_absolute()]


@dataclass
class Planter:
    """A run, the commands that are given on it, and a folder outside with the user's files."""

    root: Path
    folder: Path
    """The run."""
    dag: Stages
    commands: Commands
    words: Mapping[str, Path]
    """Word of a command, or begin of one -> path in its place."""
    trace: Trace = field(init=False)

    def __post_init__(self) -> None:
        self.trace = Trace(self.folder, self.root / "outside")
        sys.addaudithook(self.trace)
        self.first = self.root / "first"
        shutil.copytree(self.folder, self.first, symlinks=True)

    def give(self, command: Sequence[str]) -> int:
        """Give a command, and return its exit code."""
        return give(command, self.dag, self.words)

    def restore(self) -> None:
        shutil.rmtree(self.folder)
        shutil.copytree(self.first, self.folder, symlinks=True)
        shutil.rmtree(self.trace.outside, ignore_errors=True)
        self.trace.outside.mkdir()

    def paths(self) -> list[Path]:
        """Return every path that the commands use below the run, in order, with those that exist at first."""
        self.restore()
        self.trace.used = set()
        self.trace.on = True
        for command in self.commands:
            assert self.give(command) == 0, command
        self.trace.on = False
        found = self.trace.used | {path.relative_to(self.first) for path in self.first.rglob("*")}
        found |= {parent for path in found for parent in path.parents}
        return sorted(path for path in found if path.parts and not NEW_EACH_TIME.search(f"/{path}"))

    def plant(self, path: Path, kind: str) -> bool:
        """Put a link to a copy in the place of ``path``. Return False if that is impossible."""
        self.restore()
        place, goal = self.folder / path, self.trace.outside / "goal"
        try:
            place.parent.mkdir(parents=True, exist_ok=True)
        except OSError:
            return False  # traced in an unknown folder, and not in this one
        was_folder = place.is_dir()
        if place.is_symlink() or not place.exists():
            goal.write_text("thesis")
        elif was_folder:
            shutil.copytree(place, goal, symlinks=True)
            (goal / "thesis.tex").write_text("years")
            (goal / f"{9:064x}").mkdir()
            (goal / f"{9:064x}" / "thesis.tex").write_text("years")
        else:
            shutil.copy2(place, goal)
        if place.is_dir() and not place.is_symlink():
            shutil.rmtree(place)
        else:
            place.unlink(missing_ok=True)
        if kind == "hard link":
            if was_folder:
                return False
            place.hardlink_to(goal)
        elif kind == "FIFO":
            os.mkfifo(place)
        else:
            targets = {
                "link": goal,
                "relative link": Path(os.path.relpath(goal, place.parent)),
                "dangling link": self.trace.outside / "new",
                "link to the run": self.folder,
                "link to a link": self.trace.outside / "another",
                "link to the parent": Path(".."),
            }
            (self.trace.outside / "another").symlink_to(goal)
            place.symlink_to(targets[kind])
        return True

    def check(self, path: Path, kind: str) -> bool:
        """Plant a link, give all commands, and check the outside. Return False if it cannot be planted."""
        if not self.plant(path, kind):
            return False
        outside = self.trace.outside
        before = snapshot(outside)
        self.trace.touched = set()
        for command in self.commands:
            age(outside)
            self.trace.on = kind != "hard link"
            self.give(command)
            self.trace.on = False
            read = set() if kind == "hard link" else read_since(outside)
            assert not read | self.trace.touched, (
                f"{command} with a {kind} at {path}: {self.trace.touched or read}"
            )
            assert snapshot(outside) == before, f"{command} with a {kind} at {path}"
        return True


def give(command: Sequence[str], dag: Stages, words: Mapping[str, Path]) -> int:
    """Give a command with a path for each of the ``words``, and return its exit code."""
    arguments = []
    for argument in command:
        word, slash, rest = argument.partition("/")
        arguments.append(f"{words[word]}{slash}{rest}" if word in words else argument)
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()) as said:
        code = invoke(arguments, dag)
    assert "unexpected" not in said.getvalue(), f"{command}: {said.getvalue()}"
    return code


def toy_run(root: Path) -> Planter:
    """Make a run with finished, unused, cached and unfinished work."""
    bench = toy.make_bench(root)
    recipe = root / "recipe.toml"
    recipe.write_text("[square]\npower = 2\n")
    words = {"RUN": bench.folder, "CAPTURE": bench.capture}
    for power in (3, 2):
        more = ("--recipe", str(recipe), "--set", f"square.power={power}")
        assert give(("run", "CAPTURE", "-o", "RUN", "--no-report", *more), bench.dag, words) == 0
    noted = toy.note

    def interrupting(journal: Path, line: str) -> None:
        if line == "square 3.txt":
            raise KeyboardInterrupt
        noted(journal, line)

    toy.note = interrupting
    try:
        assert give(TOY_COMMANDS[2], bench.dag, words) == 130
    finally:
        toy.note = noted
    assert list(bench.store.glob("work/*/checkpoints/state.txt"))
    kept = bench.store / "kept" / "square" / f"{5:064x}.json"
    kept.parent.mkdir(parents=True)
    kept.write_text("{}")
    return Planter(root, bench.folder, bench.dag, TOY_COMMANDS, words)


def finished_run(root: Path) -> Planter:
    """Make a finished run with its results in a store, a report and an evaluation."""
    made = FinishedRun(root, held_out=(0, 3))
    write_sparse(made.folder / "ingest")
    write_no_formation(made.folder / "consolidate")
    made.finish("consolidate", {"psnr_unseen": 24.6})
    for stage in made.dag.names:
        manifest = linked_manifest(made.folder, stage)
        assert manifest is not None
        results = made.folder / ".store" / stage / manifest.key
        results.parent.mkdir(parents=True)
        (made.folder / stage).rename(results)
        (made.folder / stage).symlink_to(results.relative_to(made.folder))
    (made.folder / "scene.ply").symlink_to("consolidate/scene.ply")
    (root / "out").mkdir()
    words = {"RUN": made.folder, "OUT": root / "out"}
    for command in SCENE_COMMANDS:
        assert give(command, made.dag, words) == 0, command
    return Planter(root, made.folder, made.dag, SCENE_COMMANDS, words)


def snapshot(folder: Path) -> dict[str, tuple[int, bytes | str]]:
    """Name -> modification time and content, of everything below ``folder``."""
    found: dict[str, tuple[int, bytes | str]] = {}
    for path in (folder, *sorted(folder.rglob("*"))):
        content = str(path.readlink()) if path.is_symlink() else path.read_bytes() if path.is_file() else ""
        found[str(path)] = (path.lstat().st_mtime_ns, content)
    return found


def packed_run(root: Path) -> Planter:
    """Pack a finished run, and unpack it."""
    words = {"RUN": finished_run(root).folder, "OUT": root}
    assert give(("pack", "RUN", "-o", "OUT/run.zip"), installed(), words) == 0
    shutil.unpack_archive(root / "run.zip", root / "packed")
    words["RUN"] = root / "packed" / "run"
    return Planter(root / "packed", words["RUN"], installed(), PACKED_COMMANDS, words)


def age(folder: Path) -> None:
    """Set the access times in ``folder`` to 0. They show reads by libraries, which no hook sees."""
    for path in folder.rglob("*"):
        if path.is_file() and not path.is_symlink():
            os.utime(path, ns=(0, path.stat().st_mtime_ns))


def read_since(folder: Path) -> set[str]:
    """Return the files in ``folder`` that were read since `age`."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    return {str(path) for path in files if path.stat().st_atime_ns}


def planted(
    root: Path, make: Callable[[Path], Planter], kinds: Sequence[str] = KINDS, depth: int = 99
) -> Iterator[tuple[Path, str]]:
    """Check links of all ``kinds`` at all paths of at most ``depth`` parts, and yield each path and kind."""
    planter = make(root)
    for path in (path for path in planter.paths() if len(path.parts) <= depth):
        for kind in kinds:
            if planter.check(path, kind):
                yield path, kind


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--links", type=int, default=1000)
    links = parser.parse_args().links
    root = Path(tempfile.mkdtemp(prefix="cleargs-planted-"))
    done = []
    shares = {toy_run: links // 2, finished_run: links - links // 2 - links // 10, packed_run: links // 10}
    for make, share in shares.items():
        (root / make.__name__).mkdir()
        done += islice(planted(root / make.__name__, make), share)
    shutil.rmtree(root)
    places = len({path for path, _ in done})
    print(f"{len(done)} links at {places} paths: nothing outside was read or changed")


if __name__ == "__main__":
    main()
