"""How far each scene of a batch is, read from handles and statuses at any time, from any node."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from cleargs.batch.folder import BatchFolder, Plan, Status

State = Literal["done", "partial", "failed", "running", "waiting"]


@dataclass(frozen=True)
class SceneState:
    """How far one scene is."""

    scene: str
    state: State
    stage: str
    """The stage that runs, failed or comes next; the last one of a finished scene."""
    finished: int
    """Number of finished stages."""
    cause: str = ""
    where: str = ""
    """Node and job of what runs."""
    log: Path | None = None


def scene_states(folder: BatchFolder, plan: Plan, *, ended: bool = False) -> list[SceneState]:
    """The state of each scene. With ``ended`` the engine is gone: what still says "running" has died."""
    return [_scene_state(folder, scene, plan.wanted, ended=ended) for scene in plan.scenes]


def _scene_state(folder: BatchFolder, scene: str, stages: tuple[str, ...], *, ended: bool) -> SceneState:
    finished = 0
    for stage in stages:
        if folder.read_handle(scene, stage) is None:
            return _unfinished(folder, scene, stage, finished, ended=ended)
        finished += 1
    last = folder.read_handle(scene, stages[-1])
    partial = last is not None and last.status == "partial"
    return SceneState(scene, "partial" if partial else "done", stages[-1], finished)


def _unfinished(folder: BatchFolder, scene: str, stage: str, finished: int, *, ended: bool) -> SceneState:
    """The state of a scene whose first unfinished stage is ``stage``."""
    status, log = folder.read_status(scene, stage), folder.log(scene, stage)
    if status is None:
        if ended:
            return SceneState(scene, "failed", stage, finished, "its job never ran", log=folder.engine_log)
        return SceneState(scene, "waiting", stage, finished)
    if status.state in ("failed", "partial"):
        state: State = "failed" if status.state == "failed" else "partial"
        return SceneState(scene, state, stage, finished, status.cause, log=log)
    if ended:
        words = {"running": "its job ended without a word", "interrupted": "interrupted"}
        cause = words.get(status.state, f"its job was {status.state} last")
        return SceneState(scene, "failed", stage, finished, f"{cause}; see {folder.engine_log}", log=log)
    if status.state == "running":
        return SceneState(scene, "running", stage, finished, _last_line(log), _where(status), log)
    if status.state == "done":  # what it was done from has changed since
        return SceneState(scene, "waiting", stage, finished)
    return SceneState(scene, "waiting", stage, finished, status.state, log=log)


def _where(status: Status) -> str:
    return f"{status.node}, job {status.job}" if status.job else status.node


def _last_line(log: Path) -> str:
    """What a running stage said last."""
    try:
        with log.open("rb") as file:
            file.seek(max(0, log.stat().st_size - 2000))
            lines = file.read().decode("utf-8", "replace").splitlines()
    except OSError:
        return ""
    return next((line for line in reversed(lines) if line.strip() and not line.startswith("== ")), "")
