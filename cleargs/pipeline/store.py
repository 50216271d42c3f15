"""The store: finished stage folders by content key, unfinished work next to them.

::

    STORE/<stage>/<key>/                   finished: every output and manifest.json; never written again
    STORE/work/<key>/{out,checkpoints}/    unfinished: survives kill -9, the next try resumes from it
    STORE/locks/<key>.lock                 held by the one process that works on the key, with its name
    STORE/kept/<stage>/                    findings about single items, by digest; safe to delete
    STORE/locks/store.lock  STORE/roots/  STORE/digests.sqlite

On a file system without locks each process works in its own folder, ``<key>@<process>``. Several may make the
same results, and the rename decides.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from cleargs.digest import DigestMemo
from cleargs.errors import StoreError
from cleargs.files import disk_errors, is_partial, sync, sync_tree, write_bytes
from cleargs.manifest import (
    MANIFEST,
    Manifest,
    damages,
    hidden_link,
    read_manifest,
    write_manifest,
)
from cleargs.pipeline.lock import file_lock, is_locked, only_one
from cleargs.progress import Reporter
from cleargs.safe_io import FAULTS, read_text

STORE_FOLDER = ".store"
"""Where a run keeps its store unless told otherwise."""

ROOTS = "roots"
"""Folder in a store that notes the runs which use it."""

SECONDS = "seconds"
"""File in a work folder: how long the tries before took."""


Kind = Literal["finished", "unfinished", "kept", "rubbish"]
"""What a folder holds that nothing needs."""


@dataclass(frozen=True)
class Entry:
    """What the store holds for one key."""

    folder: Path
    manifest: Manifest | None
    damage: str | None = None
    """Why the folder cannot be used; None when every file is what the manifest says."""

    @property
    def usable(self) -> Manifest | None:
        """The manifest, where nothing is damaged."""
        return self.manifest if self.damage is None else None

    @property
    def whole(self) -> Manifest | None:
        """The manifest, where nothing is damaged and the stage left nothing out."""
        return self.usable if self.usable is not None and not self.usable.missing else None


@dataclass(frozen=True)
class WorkFolder:
    """Where one key is being worked on."""

    folder: Path

    @property
    def out(self) -> Path:
        """Outputs so far."""
        return self.folder / "out"

    @property
    def checkpoints(self) -> Path:
        """In-stage state, never published."""
        return self.folder / "checkpoints"

    @property
    def seconds(self) -> float:
        """What earlier tries of the same work took, as far as they could say."""
        try:
            return float((self.folder / SECONDS).read_text(encoding="ascii"))
        except (OSError, ValueError):
            return 0.0

    def note_seconds(self, seconds: float) -> None:
        """Keep the time that all tries took so far; a disk that is full loses it."""
        with suppress(OSError):
            (self.folder / SECONDS).write_text(f"{seconds:.3f}", encoding="ascii")


class Store:
    """A folder of finished results, which runs and processes may share."""

    def __init__(self, root: Path, memo: DigestMemo) -> None:
        self.root = root
        self.memo = memo

    # -- reading ---------------------------------------------------------------------------------------

    def folder(self, stage: str, key: str) -> Path:
        """Where the finished results of ``key`` lie, or would."""
        return self.root / stage / key

    def find(self, stage: str, key: str) -> Entry | None:
        """What is stored under ``key``, checked: sizes always, digests through the memo; None for nothing."""
        folder = self.folder(stage, key)
        try:
            manifest = read_manifest(folder)
        except FileNotFoundError:
            return Entry(folder, None, "it has no manifest") if folder.is_dir() else None
        except (ValueError, OSError) as error:
            return Entry(folder, None, str(error))
        if manifest.key != key or manifest.stage != stage:
            return Entry(folder, None, "the manifest belongs to another folder")
        return Entry(folder, manifest, next(damages(folder, manifest, manifest.files, self.memo), None))

    # -- working ---------------------------------------------------------------------------------------

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """Held by whoever works in the store, so that nothing is cleared away under its feet.

        In somebody else's store that may only be read there is nothing to hold: its results can be shown.
        """
        if self._only_readable():
            yield
            return
        with file_lock(self.root / "locks" / "store.lock", shared=True):
            yield

    @contextmanager
    def lock(self, key: str, reporter: Reporter, stage: str) -> Iterator[bool]:
        """Hold the work on ``key``; wait while another process has it, and say which one.

        Yields whether this process is alone: a file system without locks keeps nobody apart.
        """
        if self._only_readable():
            raise StoreError(
                f"{stage} is to be made, but the store {self.root} may only be read",
                hint="choose a --store of your own",
            )
        with only_one(self.root / "locks" / f"{key}.lock", reporter, stage) as alone:
            try:
                yield alone
            finally:  # this process's own work folders are left to the next try
                for folder in (self.root / "work").glob(f"{key}*{self._owner_suffix()}"):
                    with suppress(OSError):  # another process left something there already
                        folder.rename(folder.with_name(folder.name.removesuffix(self._owner_suffix())))

    def _only_readable(self) -> bool:
        return self.root.is_dir() and not os.access(self.root, os.W_OK)

    def _owner_suffix(self) -> str:
        """The ending of this process's own work folders, where no lock keeps another one out."""
        return f"@{socket.gethostname()}-{os.getpid()}"

    def open_work(
        self,
        key: str,
        *,
        fresh: bool,
        entry: Entry | None,
        leftovers: Sequence[str] = (),
        alone: bool = True,
    ) -> WorkFolder:
        """The work folder of ``key``, ready to resume: of the outputs that dead writers left, only those stay
        that match one of the patterns ``leftovers``. Where this process is not ``alone``, the folder is its
        own.

        A forced rebuild (``fresh``) has a folder of its own, which resumes only from an interrupted forced
        try. What a partial ``entry`` already holds is carried over once.
        """
        work = WorkFolder(self.root / "work" / (f"{key}.forced" if fresh else key))
        with disk_errors(work.folder):
            if not alone:
                left, work = work, WorkFolder(work.folder.with_name(work.folder.name + self._owner_suffix()))
                with suppress(OSError):  # nothing is there, or another process took it
                    left.folder.rename(work.folder)
            _keep_only(work.out, leftovers)
            if entry is not None and entry.usable is not None and not fresh and not work.out.exists():
                _link_files(entry.folder, work.out)
            work.out.mkdir(parents=True, exist_ok=True)
            work.checkpoints.mkdir(parents=True, exist_ok=True)
            (work.out / MANIFEST).unlink(missing_ok=True)
            for file in work.checkpoints.rglob("*"):
                if is_partial(file) and not file.is_dir():
                    file.unlink()
        return work

    def publish(self, work: WorkFolder, manifest: Manifest) -> Manifest:
        """Move the outputs of ``work`` to their final place: all or nothing, and durable.

        Where a whole result with the same content is already there, ours is dropped and that one's manifest
        returned. A partial, damaged or differing one makes room.
        """
        final = self.folder(manifest.stage, manifest.key)
        with disk_errors(final):
            write_manifest(work.out, manifest)
            sync_tree(work.out)
            final.parent.mkdir(parents=True, exist_ok=True)
            there = self.find(manifest.stage, manifest.key)
            if there is not None:
                if there.whole is not None and there.whole.digest == manifest.digest:
                    self.discard(work.folder)
                    return there.whole
                self.discard(final)
            try:
                work.out.rename(final)
            except OSError:
                # Another writer published in this moment (on a file system without locks): it won.
                winner = self.find(manifest.stage, manifest.key)
                if winner is None or winner.usable is None:
                    raise
                self.discard(work.folder)
                return winner.usable
            sync(final.parent)
        for name, record in manifest.files.items():
            self.memo.remember(final / name, record.digest)
        if not manifest.missing:
            with suppress(StoreError):  # the result is there, whatever becomes of what is left
                self.discard(work.folder)
        return manifest

    def discard(self, folder: Path) -> None:
        """Take ``folder`` away in one step, then delete it at leisure."""
        rubbish = self.root / "work" / f".rubbish-{folder.name}-{os.getpid()}"
        rubbish.parent.mkdir(parents=True, exist_ok=True)
        with disk_errors(folder), suppress(FileNotFoundError):
            folder.rename(rubbish)
        shutil.rmtree(rubbish, ignore_errors=True)

    def cache_folder(self, stage: str) -> Path:
        """Where ``stage`` keeps what it found out about single items."""
        return self.root / "kept" / stage

    # -- links from runs -------------------------------------------------------------------------------

    def link(self, run: Path, stage: str, key: str) -> None:
        """Let ``RUN/<stage>`` show the finished folder: a link replaced by rename, relative inside RUN."""
        target = self.folder(stage, key)
        if target.is_relative_to(run):
            target = target.relative_to(run)
        link = run / stage
        if link.is_symlink() and link.readlink() == target:
            return
        if link.exists() and not link.is_symlink():
            raise StoreError(
                f"{link} is a folder, not a link into the store", hint="move it away, or choose another -o"
            )
        temporary = run / f".{stage}.link-{os.getpid()}"
        with disk_errors(link):
            temporary.unlink(missing_ok=True)
            temporary.symlink_to(target)
            temporary.replace(link)
            hidden_link(run, stage).unlink(missing_ok=True)

    def unlink(self, run: Path, stage: str) -> None:
        """Let ``RUN/<stage>`` show nothing. What it showed stays in the store, and known to `last_shown`."""
        link = run / stage
        if link.is_symlink():
            with suppress(FileNotFoundError):  # another process did it
                link.replace(hidden_link(run, stage))

    def add_root(self, run: Path) -> None:
        """Note that ``run`` links into this store, so that `collect` keeps what it shows."""
        name = hashlib.sha256(str(run).encode()).hexdigest()[:16]
        note = self.root / ROOTS / name
        if not note.exists() and not self._only_readable():
            with disk_errors(note):
                note.parent.mkdir(parents=True, exist_ok=True)
                write_bytes(note, f"{run}\n".encode())

    # -- clearing --------------------------------------------------------------------------------------

    def collect(self, stages: tuple[str, ...], *, checkpoints: bool, dry_run: bool) -> list[Garbage]:
        """Remove the finished folders that no run links to; with ``checkpoints`` unfinished work and what is
        kept about single items too.

        Raises StoreError when a run is at work in the store, or where the file system cannot tell.
        """
        with file_lock(self.root / "locks" / "store.lock", wait=False) as alone:
            if alone is False:
                raise StoreError("a run is at work in this store", hint="try again when it is done")
            if alone is None and not dry_run:
                raise StoreError(
                    f"the file system of {self.root} has no locks, which would keep data in use",
                    hint="when no run works there, delete the folders that --dry-run lists",
                )
            runs = [self.root.parent] if self.root.name == STORE_FOLDER else []
            for note in (self.root / ROOTS).glob("*"):
                with suppress(*FAULTS):
                    runs.append(Path(read_text(note).rstrip("\n")))
            links = [run / stage for run in runs for stage in stages]
            linked = {link.resolve() for link in links if link.is_symlink()}
            folders: list[tuple[Path, Kind]] = [
                (folder, "finished")
                for stage in stages
                for folder in sorted((self.root / stage).glob("*"))
                if folder.resolve() not in linked
            ]
            for folder in sorted((self.root / "work").glob("*")):
                folders.append((folder, "rubbish" if folder.name.startswith(".rubbish-") else "unfinished"))
            folders += [(folder, "kept") for folder in sorted((self.root / "kept").glob("*"))]
            found = [
                Garbage(
                    folder, kind, sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
                )
                for folder, kind in folders
                if checkpoints or kind in ("finished", "rubbish")
            ]
            if not dry_run:
                for garbage in found:
                    self.discard(garbage.folder)
                for lock in (self.root / "locks").glob("*.lock"):
                    if lock.name != "store.lock":
                        lock.unlink(missing_ok=True)
        return found


@dataclass(frozen=True)
class Garbage:
    """A folder that nothing needs."""

    folder: Path
    kind: Kind
    bytes: int


def writer_is_alive(work: Path) -> bool:
    """Return True if a process works in the work folder ``work``."""
    key = work.name.partition("@")[0].removesuffix(".forced")
    return work.is_dir() and is_locked(work.parent.parent / "locks" / f"{key}.lock")


def _keep_only(out: Path, patterns: Sequence[str]) -> None:
    """Leave nothing in ``out`` but files that match a pattern, and their folders."""
    known = {file for pattern in patterns for file in out.glob(pattern)}
    for place in sorted(out.rglob("*"), reverse=True):  # what is in a folder before the folder
        if place.is_dir() and not place.is_symlink():
            if not any(place.iterdir()):
                place.rmdir()
        elif place not in known or not place.is_file() or is_partial(place):
            place.unlink()


def _link_files(source: Path, target: Path) -> None:
    """Bring the files of ``source`` into ``target`` without copying their content where hard links work.

    Stages replace files by rename and never write into one, so that the source stays as it was. The copy is
    made next to its place, so that a killed one is not mistaken for a whole one.
    """
    beside = target.with_name(f"{target.name}.carried")
    shutil.rmtree(beside, ignore_errors=True)
    try:
        shutil.copytree(source, beside, copy_function=os.link)
    except OSError:  # shutil.Error is one
        shutil.rmtree(beside)
        shutil.copytree(source, beside)
    beside.rename(target)
