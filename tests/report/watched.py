"""A finished run that is served, with a stage that may be running again."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from report_run import FinishedRun

from cleargs.digest import DigestMemo
from cleargs.pipeline.live import recorded_progress
from cleargs.pipeline.lock import file_lock
from cleargs.pipeline.store import Store
from cleargs.progress import Reporter, SilentReporter
from cleargs.report.page import write_report
from cleargs.report.serve import Server


def reported(root: Path) -> FinishedRun:
    """A run with its report."""
    made = FinishedRun(root)
    store = made.folder / ".store"
    (store / "locks").mkdir(parents=True)
    (store / "locks" / "store.lock").touch()
    with DigestMemo(store / "digests.json") as memo:
        write_report(made.planner(Store(store, memo)))
    return made


@contextmanager
def serving(made: FinishedRun) -> Iterator[int]:
    """Serve a run; yield the port."""
    with Server(made.dag, made.run, "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield int(server.server_address[1])
        finally:
            server.shutdown()
            thread.join()


@contextmanager
def working(made: FinishedRun, stage: str) -> Iterator[tuple[Reporter, Path]]:
    """Pretend that ``stage`` is running; yield its reporter and its checkpoint folder."""
    store, work = made.run.store, made.run.store / "work" / "key"
    (work / "checkpoints" / "round_01").mkdir(parents=True)
    try:
        with (
            file_lock(store / "locks" / "key.lock"),
            recorded_progress(SilentReporter(), made.folder, stage, work) as reporter,
        ):
            yield reporter, work / "checkpoints"
    finally:
        shutil.rmtree(work)
