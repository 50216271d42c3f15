"""Plant links in a run folder, as a hostile sender could, and check that nothing outside is read or changed.

``python tests/planted_links.py --links 1000`` traces all commands on a toy run to find every path that they
open, list, create, rename or delete. At each path it plants links of several kinds, one at a time. Then it
gives the commands again.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, field
from io import StringIO
from itertools import islice
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parent / "pipeline"))

import toy

from cleargs.cli.main import invoke

COMMANDS: tuple[tuple[str, ...], ...] = (
    ("status", "RUN"),
    ("show", "RUN"),
    ("run", "CAPTURE", "-o", "RUN", "--no-report", "--set", "square.power=4", "--log", "RUN/all.log"),
    ("verify", "RUN"),
    ("run", "CAPTURE", "-o", "RUN", "--no-report", "--set", "square.power=2", "--force", "total"),
    ("gc", "RUN", "--checkpoints", "--yes"),
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
            for path in arguments[:2]:
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
    """A run with finished, unused, cached and unfinished work, and a folder outside with the user's files."""

    root: Path
    bench: toy.Bench = field(init=False)
    trace: Trace = field(init=False)

    def __post_init__(self) -> None:
        self.bench = toy.make_bench(self.root)
        self.trace = Trace(self.bench.folder, self.root / "outside")
        sys.addaudithook(self.trace)
        recipe = self.root / "recipe.toml"
        recipe.write_text("[square]\npower = 2\n")
        capture, run = str(self.bench.capture), str(self.bench.folder)
        for power in (3, 2):
            more = ["--recipe", str(recipe), "--set", f"square.power={power}"]
            with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
                assert invoke(["run", capture, "-o", run, "--no-report", *more], self.bench.dag) == 0
        self._interrupted()
        kept = self.bench.store / "kept" / "square" / f"{5:064x}.json"
        kept.parent.mkdir(parents=True)
        kept.write_text("{}")
        self.first = self.root / "first"
        shutil.copytree(self.bench.folder, self.first, symlinks=True)

    def _interrupted(self) -> None:
        """Leave the unfinished work of a stage that was interrupted at its third number."""
        noted = toy.note

        def interrupting(journal: Path, line: str) -> None:
            if line == "square 3.txt":
                raise KeyboardInterrupt
            noted(journal, line)

        toy.note = interrupting
        try:
            assert self.give(COMMANDS[2]) == 130
        finally:
            toy.note = noted
        assert list(self.bench.store.glob("work/*/checkpoints/state.txt"))

    def give(self, command: Sequence[str]) -> int:
        """Give a command, and return its exit code."""
        words = {"RUN": str(self.bench.folder), "CAPTURE": str(self.bench.capture)}
        arguments = [words.get(word, word.replace("RUN/", f"{self.bench.folder}/")) for word in command]
        with redirect_stdout(StringIO()), redirect_stderr(StringIO()) as said:
            code = invoke(arguments, self.bench.dag)
        assert "unexpected" not in said.getvalue(), f"{command}: {said.getvalue()}"
        return code

    def restore(self) -> None:
        shutil.rmtree(self.bench.folder)
        shutil.copytree(self.first, self.bench.folder, symlinks=True)
        shutil.rmtree(self.trace.outside, ignore_errors=True)
        self.trace.outside.mkdir()

    def paths(self) -> list[Path]:
        """Return every path that the commands use below the run, in order, with those that exist at first."""
        self.restore()
        self.trace.used = set()
        self.trace.on = True
        for command in COMMANDS:
            self.give(command)
        self.trace.on = False
        found = self.trace.used | {path.relative_to(self.first) for path in self.first.rglob("*")}
        found |= {parent for path in found for parent in path.parents}
        return sorted(path for path in found if path.parts and not NEW_EACH_TIME.search(f"/{path}"))

    def plant(self, path: Path, kind: str) -> bool:
        """Put a link to a copy in the place of ``path``. Return False if that is impossible."""
        self.restore()
        place, goal = self.bench.folder / path, self.trace.outside / "goal"
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
                "link to the run": self.bench.folder,
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
        before = snapshot(self.trace.outside)
        self.trace.touched = set()
        for command in COMMANDS:
            self.trace.on = kind != "hard link"
            self.give(command)
            self.trace.on = False
            assert snapshot(self.trace.outside) == before, f"{command} with a {kind} at {path}"
            assert not self.trace.touched, f"{command} with a {kind} at {path}: {self.trace.touched}"
        return True


def snapshot(folder: Path) -> dict[str, tuple[int, bytes | str]]:
    """Name -> modification time and content, of everything below ``folder``."""
    found: dict[str, tuple[int, bytes | str]] = {}
    for path in (folder, *sorted(folder.rglob("*"))):
        content = str(path.readlink()) if path.is_symlink() else path.read_bytes() if path.is_file() else ""
        found[str(path)] = (path.lstat().st_mtime_ns, content)
    return found


def planted(root: Path, kinds: Sequence[str] = KINDS, depth: int = 99) -> Iterator[tuple[Path, str]]:
    """Check links of all ``kinds`` at all paths of at most ``depth`` parts, and yield each path and kind."""
    planter = Planter(root)
    for path in (path for path in planter.paths() if len(path.parts) <= depth):
        for kind in kinds:
            if planter.check(path, kind):
                yield path, kind


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--links", type=int, default=1000)
    root = Path(tempfile.mkdtemp(prefix="cleargs-planted-"))
    done = list(islice(planted(root), parser.parse_args().links))
    shutil.rmtree(root)
    print(
        f"{len(done)} links at {len({path for path, _ in done})} paths: nothing outside was read or changed"
    )


if __name__ == "__main__":
    main()
