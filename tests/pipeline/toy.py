"""A pipeline of toy stages: count numbers, square them, add them up. It is also a program to kill in tests.

``python toy.py JOURNAL ARGUMENTS...`` is ``cleargs ARGUMENTS...`` with these stages. They append a line to
the file JOURNAL for each piece of work that they do.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from cleargs.digest import DigestMemo
from cleargs.errors import StageError
from cleargs.files import write_bytes
from cleargs.pipeline.config import check_document, merge, parse_override
from cleargs.pipeline.plan import Planner, StagePlan
from cleargs.pipeline.run_file import RunSpec
from cleargs.pipeline.runner import Runner, StageOutcome
from cleargs.pipeline.stage import Estimate, Stage, StageContext, StageResult
from cleargs.pipeline.stages import Stages
from cleargs.pipeline.store import Store
from cleargs.progress import SilentReporter


class Inner(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    depth: int = Field(3, ge=1, le=9)


class CountConfig(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    limit: int = Field(100, ge=1, le=1000, description="maximum count of numbers")
    mode: Literal["plain", "padded"] = "plain"
    weights: str = Field("", description="a file", json_schema_extra={"key": False})
    inner: Inner = Inner(depth=3)


class SquareConfig(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    power: int = Field(2, ge=1, le=4)
    delay_s: float = Field(0.0, ge=0, le=1, json_schema_extra={"key": False})
    hold: str = Field("", description="a file", json_schema_extra={"key": False})


class TotalConfig(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    offset: float = Field(0.0, ge=-1, le=1)


@dataclass
class Count:
    """Input files -> numbers/*.txt, numbers.txt. Reads one number from each input file."""

    journal: Path
    VERSION: int = 1
    CONFIG: type[BaseModel] = CountConfig
    INPUTS: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    OUTPUTS: tuple[str, ...] = ("numbers", "log.txt")
    LEFTOVERS: tuple[str, ...] = ("numbers/*.txt",)
    SETTINGS: tuple[str, ...] = ()
    LIBRARIES: tuple[str, ...] = ("pydantic",)

    def externals(self, config: Any, source: Path) -> Mapping[str, Path]:
        weights = {"weights": Path(config.weights)} if config.weights else {}
        return {"capture": source, **weights}

    def preflight(self, config: Any) -> None: ...

    def estimate(self, context: StageContext[Any]) -> Estimate:
        return Estimate(minutes=0.1, memory_gb=0.1, disk_gb=0.001, frames=6)

    def run(self, context: StageContext[Any]) -> StageResult:
        note(self.journal, "count")
        if not context.source.is_dir():
            raise StageError("the capture is not a folder", hint="give a folder")
        files = sorted(context.source.glob("*.txt"))[: context.config.limit]
        (context.out / "numbers").mkdir(exist_ok=True)
        missing = []
        for file in files:
            text = file.read_text().strip()
            if not text:
                missing.append(f"{file.name} is empty")
                continue
            if not (context.out / "numbers" / file.name).exists():
                note(self.journal, f"count {file.name}")
                write_bytes(context.out / "numbers" / file.name, text.encode())
        write_bytes(context.out / "log.txt", f"{context.config.mode}".encode())
        return StageResult(tuple(missing), {"numbers": len(files), "scale": float("inf")})


@dataclass
class Square:
    """numbers -> powers/*.txt, one at a time, so that a killed attempt resumes.

    After the first number, the stage notes ``held`` and waits while the file ``hold`` exists. During this
    time a test can examine the running stage.
    """

    journal: Path
    VERSION: int = 1
    CONFIG: type[BaseModel] = SquareConfig
    INPUTS: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: {"count": ("numbers", "masks")})
    OUTPUTS: tuple[str, ...] = ("powers",)
    LEFTOVERS: tuple[str, ...] = ("powers/[0-9]*.txt",)
    SETTINGS: tuple[str, ...] = ()
    LIBRARIES: tuple[str, ...] = ()

    def externals(self, config: Any, source: Path) -> Mapping[str, Path]:
        return {}

    def preflight(self, config: Any) -> None: ...

    def estimate(self, context: StageContext[Any]) -> Estimate:
        """One minute per number; the number of them is estimated until ``count`` is done."""
        folder = context.inputs.get("count")
        numbers = context.expected["count"].frames if folder is None else len(list(folder.glob("numbers/*")))
        return Estimate(minutes=float(numbers), memory_gb=0.1, disk_gb=0.001)

    def run(self, context: StageContext[Any]) -> StageResult:
        note(self.journal, "square")
        (context.out / "powers").mkdir(exist_ok=True)
        files = sorted((context.inputs["count"] / "numbers").iterdir())
        total = 0
        state = context.checkpoints / "state.txt"
        begin = 0
        if state.exists():
            begin, total = map(int, state.read_text().split())
        with context.reporter.task("square", len(files)) as task:
            for index, file in enumerate(files[begin:], begin):
                power = int(file.read_text()) ** context.config.power
                note(self.journal, f"square {file.name}")
                write_bytes(context.out / "powers" / file.name, str(power).encode())
                time.sleep(context.config.delay_s)
                total += power
                write_bytes(state, f"{index + 1} {total}".encode())
                task.advance()
                if index == 0 and context.config.hold:
                    self._wait_while(Path(context.config.hold))
        write_bytes(context.out / "powers" / "total.txt", str(total).encode())
        return StageResult(summary={"total": total})

    def _wait_while(self, hold: Path) -> None:
        note(self.journal, "held")
        while hold.exists():
            time.sleep(0.02)


@dataclass
class Total:
    """powers/total.txt and log.txt -> total.txt."""

    journal: Path
    VERSION: int = 1
    CONFIG: type[BaseModel] = TotalConfig
    INPUTS: Mapping[str, tuple[str, ...]] = field(
        default_factory=lambda: {"count": ("log.txt",), "square": ("powers/total.txt",)}
    )
    OUTPUTS: tuple[str, ...] = ("total.txt",)
    LEFTOVERS: tuple[str, ...] = ()
    SETTINGS: tuple[str, ...] = ()
    LIBRARIES: tuple[str, ...] = ()

    def externals(self, config: Any, source: Path) -> Mapping[str, Path]:
        return {}

    def preflight(self, config: Any) -> None: ...

    def estimate(self, context: StageContext[Any]) -> Estimate:
        return Estimate(minutes=0.3, memory_gb=0.1, disk_gb=0.001)

    def run(self, context: StageContext[Any]) -> StageResult:
        note(self.journal, "total")
        total = int((context.inputs["square"] / "powers" / "total.txt").read_text())
        log = (context.inputs["count"] / "log.txt").read_text()
        write_bytes(
            context.out / "total.txt", f"{log} {total + context.config.offset} {context.seed}".encode()
        )
        return StageResult()


def note(journal: Path, line: str) -> None:
    with journal.open("a") as file:
        file.write(line + "\n")


def toy_dag(journal: Path) -> Stages:
    stages: dict[str, Stage] = {"count": Count(journal), "square": Square(journal), "total": Total(journal)}
    return Stages(tuple(stages), stages.__getitem__)


class Remarks(SilentReporter):
    """A reporter that keeps all messages."""

    def __init__(self) -> None:
        self.warnings: list[str] = []
        self.lines: list[str] = []

    def info(self, text: str) -> None:
        self.lines.append(text)

    def warn(self, text: str) -> None:
        self.warnings.append(text)


@dataclass
class Bench:
    """A toy run. Each call opens the store again, as a new process would."""

    root: Path
    dag: Stages
    remarks: Remarks

    @property
    def capture(self) -> Path:
        return self.root / "capture"

    @property
    def folder(self) -> Path:
        return self.root / "run"

    @property
    def store(self) -> Path:
        return self.folder / ".store"

    @property
    def journal(self) -> Path:
        return self.root / "journal"

    def work_done(self) -> list[str]:
        """Return the lines that stages noted since the last call."""
        lines = self.journal.read_text().splitlines() if self.journal.exists() else []
        self.journal.unlink(missing_ok=True)
        return lines

    def settings(self, overrides: Sequence[str] = (), seed: int = 0, store: Path | None = None) -> RunSpec:
        document = {"seed": seed}
        for text in overrides:
            document = merge(document, parse_override(text))
        config = check_document(self.dag, document)
        return RunSpec(self.folder, self.capture, config, store or self.store, "cpu")

    def run(
        self,
        *overrides: str,
        until: str | None = None,
        force: Sequence[str] = (),
        allow_partial: bool = False,
        seed: int = 0,
        threads: int = 1,
        store: Path | None = None,
    ) -> list[StageOutcome]:
        settings = self.settings(overrides, seed, store)
        with DigestMemo(settings.store / "digests.json") as memo:
            runner = Runner(self.dag, settings, Store(settings.store, memo), threads, self.remarks)
            return runner.run_until(until, force=force, allow_partial=allow_partial)

    def plan(self, *overrides: str, seed: int = 0) -> dict[str, StagePlan]:
        settings = self.settings(overrides, seed)
        with DigestMemo(settings.store / "digests.json") as memo:
            planner = Planner(self.dag, settings, Store(settings.store, memo), 1, self.remarks)
            return {plan.stage: plan for plan in planner.plan()}

    def digests(self) -> dict[str, str]:
        """Return stage -> digest of its published tree, as found by another process."""
        return {outcome.stage: outcome.manifest.digest for outcome in self.run()}


def make_bench(root: Path) -> Bench:
    """Make a capture of six numbers, without a run."""
    capture = root / "capture"
    capture.mkdir()
    for number in range(6):
        (capture / f"{number}.txt").write_text(str(number))
    return Bench(root, toy_dag(root / "journal"), Remarks())


if __name__ == "__main__":
    from cleargs.cli.main import main

    main(sys.argv[2:], toy_dag(Path(sys.argv[1])))
