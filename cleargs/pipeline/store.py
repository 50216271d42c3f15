"""The store: finished results of stages by content key, and unfinished work.

::

    STORE/<stage>/<key>/                   finished: all outputs and manifest.json; outputs never change
    STORE/work/<key>/{out,checkpoints}/    unfinished: survives kill -9; the next attempt resumes from it
    STORE/locks/<key>.lock                 lock of the process that works on the key; the file names it
    STORE/kept/<stage>/                    cache of results per item, by digest; safe to delete
    STORE/locks/store.lock                 shared lock of all processes that use the store
    STORE/roots/                           the runs that use the store
    STORE/digests.json                     digests of files that were read before

On a file system without locks, each process works in its own folder, ``<key>@<process>``. If several make the
same results, the first rename into ``STORE/<stage>/`` wins.

The store makes no links. It refuses or removes those that another made, and does not follow them.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import shutil
import socket
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from cleargs.digest import DigestMemo
from cleargs.errors import InputError, StoreError, listed
from cleargs.files import disk_errors, is_partial, remove, sync, sync_tree, write_bytes
from cleargs.manifest import MANIFEST, Manifest, damages, hidden_link, read_manifest, write_manifest
from cleargs.own_files import drop_links, has_only_files, refuse_links, regular_files, size_of
from cleargs.pipeline.lock import exclusive_lock, file_lock, is_locked
from cleargs.progress import Reporter
from cleargs.safe_io import FAULTS, read_bytes

STORE_FOLDER = ".store"
"""Folder of the store in a run, by default."""

ROOTS = "roots"
"""Folder in a store with one file per run that uses it."""

COPY = ".copy-of"
"""File with the key in ``RUN/<stage>``, if that is a copy: the disk has no links."""

MEMO = "digests.json"
"""File in a store with the digests of files that were read before."""

_KEY = r"[0-9a-f]{64}"
_WORK = re.compile(rf"{_KEY}(\.forced)?(@.+)?")
_RUBBISH = re.compile(r"\.rubbish-.+-\w+")
_CACHED = re.compile(rf"{_KEY}(\.\w+)?")
"""Forms of the names of results, work folders, remains of deleted folders, and files of a cache."""

SECONDS = "seconds"
"""File in a work folder with what earlier attempts took (`Spent`)."""


class Spent(NamedTuple):
    """Seconds that work took."""

    clock: float = 0.0
    """By the clock, without compiling kernels."""
    processor: float = 0.0
    compiling: float = 0.0

    def plus(self, other: Spent) -> Spent:
        return Spent(*(mine + theirs for mine, theirs in zip(self, other, strict=True)))


Kind = Literal["finished", "unfinished", "kept", "rubbish"]
"""Content of a folder that `Store.collect` may remove."""


@dataclass(frozen=True)
class Entry:
    """The results in the store for one key."""

    folder: Path
    manifest: Manifest | None
    damage: str | None = None
    """Reason why the results cannot be used; None if all files match the manifest."""

    @property
    def usable(self) -> Manifest | None:
        """The manifest, or None if something is damaged."""
        return self.manifest if self.damage is None else None

    @property
    def complete(self) -> Manifest | None:
        """The manifest, or None if something is damaged or missing."""
        return self.usable if self.usable is not None and not self.usable.missing else None


@dataclass(frozen=True)
class WorkFolder:
    """Folder with the unfinished work on one key."""

    folder: Path

    @property
    def out(self) -> Path:
        """Outputs so far."""
        return self.folder / "out"

    @property
    def checkpoints(self) -> Path:
        """Intermediate state of the stage, never published."""
        return self.folder / "checkpoints"

    @property
    def spent(self) -> Spent:
        """The time of earlier attempts at this work, as far as it was noted."""
        try:
            return Spent(*map(float, (self.folder / SECONDS).read_text(encoding="ascii").split()))
        except (OSError, ValueError, TypeError):
            return Spent()

    def note_spent(self, spent: Spent) -> None:
        """Write what all attempts took so far. On a full disk, it is lost."""
        with suppress(OSError):
            text = " ".join(f"{seconds:.3f}" for seconds in spent)
            (self.folder / SECONDS).write_text(text, encoding="ascii")


class Store:
    """A folder of results, which several runs and processes may share."""

    def __init__(self, root: Path, memo: DigestMemo) -> None:
        self.root = root
        self.memo = memo

    def folder(self, stage: str, key: str) -> Path:
        """Return the folder for the finished results of ``key``, which need not exist."""
        return self.root / stage / key

    def find(self, stage: str, key: str) -> Entry | None:
        """Return the results of ``key`` after a check, or None if there are none.

        The check compares the size of every file with the manifest. It compares the digests too, but reads
        only files that changed since the memo read them.
        """
        folder = self.folder(stage, key)
        if os.path.lexists(folder) and not has_only_files(folder):
            return Entry(folder, None, "there is a link or a device in it")
        try:
            manifest = read_manifest(folder)
        except FileNotFoundError:
            return Entry(folder, None, "it has no manifest") if folder.is_dir() else None
        except (ValueError, OSError) as error:
            return Entry(folder, None, str(error))
        if manifest.key != key or manifest.stage != stage:
            return Entry(folder, None, "the manifest belongs to another folder")
        return Entry(folder, manifest, next(damages(folder, manifest, manifest.files, self.memo), None))

    def in_use(self) -> AbstractContextManager[object]:
        """Hold a shared lock, so that ``cleargs gc`` in another process cannot remove data in use.

        A store that this user may only read has no lock. Its results can still be used.
        """
        if self._only_readable():
            return nullcontext()
        return file_lock(self.root / "locks" / "store.lock", shared=True)

    @contextmanager
    def lock(self, key: str, reporter: Reporter, stage: str) -> Iterator[bool]:
        """Hold the lock of ``key``, as `exclusive_lock` does. Raises StoreError if the store is read-only."""
        if self._only_readable():
            raise StoreError(
                f"{stage} has no results yet, and the store {self.root} is read-only",
                hint="choose another folder with --store",
            )
        with exclusive_lock(self.root / "locks" / f"{key}.lock", reporter, stage) as locked:
            try:
                yield locked
            finally:  # without its suffix, the next attempt finds the work folder of this process
                for folder in (self.root / "work").glob(f"{key}*{self._owner_suffix()}"):
                    with suppress(OSError):  # there is already one of another process
                        folder.rename(folder.with_name(folder.name.removesuffix(self._owner_suffix())))

    def _only_readable(self) -> bool:
        places = (self.root, self.root / "locks", self.root / "locks" / "store.lock", self.root / ROOTS)
        return any(place.exists() and not os.access(place, os.W_OK) for place in places)

    def _owner_suffix(self) -> str:
        """Return the suffix of this process's work folders on a file system without locks."""
        return f"@{socket.gethostname()}-{os.getpid()}"

    def open_work(
        self,
        key: str,
        *,
        forced: bool,
        entry: Entry | None,
        leftovers: Sequence[str] = (),
        locked: bool = True,
    ) -> WorkFolder:
        """Prepare the work folder of ``key``.

        A ``forced`` rebuild has a separate folder, and resumes only from a forced attempt. Otherwise, usable
        results in ``entry`` are copied to the outputs, unless there are outputs already. Files of a killed
        attempt stay only if they match ``leftovers``. Checkpoints stay only with the outputs that they
        continue: a process that is killed right after `publish` moved the outputs leaves only checkpoints.
        Without the lock of the key, this process works in its own folder. The common folder, if there is one,
        is renamed to this folder.
        """
        work = WorkFolder(self.root / "work" / (f"{key}.forced" if forced else key))
        with disk_errors(work.folder):
            if not locked:
                left, work = work, WorkFolder(work.folder.with_name(work.folder.name + self._owner_suffix()))
                with suppress(OSError):  # there is none, or another process took it over
                    left.folder.rename(work.folder)
            drop_links(work.folder, work.out)
            _keep_only(work.out, leftovers)
            if entry is not None and entry.usable is not None and not forced and not work.out.exists():
                _link_files(entry.folder, work.out)
            if work.folder.exists() and not work.out.exists():
                self.discard(work.folder)
            work.out.mkdir(parents=True, exist_ok=True)
            work.checkpoints.mkdir(parents=True, exist_ok=True)
            (work.out / MANIFEST).unlink(missing_ok=True)
            for file in work.checkpoints.rglob("*"):
                if is_partial(file) and not file.is_dir():
                    file.unlink()
        return work

    def publish(self, work: WorkFolder, manifest: Manifest, *, forced: bool = False) -> Manifest:
        """Move the outputs of ``work`` to their final folder, atomically and durably. Return the manifest.

        Complete results that another process published in the meantime are kept, and the outputs of ``work``
        are dropped, also if they differ: another kind of processor gives other bits, and runs may already
        build on its results. Partial or damaged ones are replaced, and with ``forced`` different ones too.
        """
        final = self.folder(manifest.stage, manifest.key)
        with disk_errors(final):
            write_manifest(work.out, manifest)
            sync_tree(work.out)
            final.parent.mkdir(parents=True, exist_ok=True)
            existing = self.find(manifest.stage, manifest.key)
            if existing is not None:
                kept = existing.complete
                if kept is not None and (not forced or kept.digest == manifest.digest):
                    self.discard(work.folder)
                    return kept
                self.discard(final)
            try:
                work.out.rename(final)
            except OSError:
                # On a file system without locks, another process published in the meantime: it won.
                winner = self.find(manifest.stage, manifest.key)
                if winner is None or winner.usable is None:
                    raise
                self.discard(work.folder)
                return winner.usable
            sync(final.parent)
        for name, record in manifest.files.items():
            self.memo.remember(final / name, record.digest)
        if not manifest.missing:
            with suppress(StoreError):  # the result is published; its work folder no longer matters
                self.discard(work.folder)
        return manifest

    def discard(self, folder: Path) -> None:
        """Rename ``folder`` in one step, so that no process uses it any more, then delete it."""
        rubbish = self.root / "work" / f".rubbish-{folder.name.lstrip('.')}-{secrets.token_hex(4)}"
        rubbish.parent.mkdir(parents=True, exist_ok=True)
        with disk_errors(folder), suppress(FileNotFoundError):
            folder.rename(rubbish)
        with suppress(OSError):
            remove(rubbish)

    def link(self, run: Path, stage: str, key: str) -> None:
        """Let the link ``RUN/<stage>`` point to the finished folder; relative if the store is in RUN.

        On a disk without links (exFAT, FAT32, many SMB shares), ``RUN/<stage>`` is a copy with a text file
        that names the key.
        """
        target = self.folder(stage, key)
        if target.is_relative_to(run):
            target = target.relative_to(run)
        link = run / stage
        if link.is_symlink() and link.readlink() == target:
            return
        if (copied := copied_key(link)) == key and self._is_whole(link):
            return
        if link.exists() and not link.is_symlink() and copied is None:
            raise StoreError(
                f"{link} is a folder, not a link into the store", hint="move it, or choose another -o"
            )
        temporary = run / f".{stage}.link-{secrets.token_hex(4)}"
        with disk_errors(link):
            try:
                temporary.symlink_to(target)
            except OSError:
                _link_files(self.folder(stage, key), temporary)
                (temporary / COPY).write_text(key, encoding="ascii")
                remove(link)
            if copied is not None:
                remove(link)
            temporary.replace(link)
            remove(hidden_link(run, stage))

    def _is_whole(self, copy: Path) -> bool:
        """Return True if the files of a copy are those of its manifest: a disk may have been unplugged."""
        with suppress(OSError, ValueError):
            manifest = read_manifest(copy)
            return not any(damages(copy, manifest, manifest.files, self.memo))
        return False

    def unlink(self, run: Path, stage: str) -> None:
        """Remove the link ``RUN/<stage>``. The results stay in the store; `last_shown` still finds them."""
        link = run / stage
        if link.is_symlink() or copied_key(link) is not None:
            with suppress(FileNotFoundError):  # another process removed it
                if not link.is_symlink():
                    remove(hidden_link(run, stage))
                link.replace(hidden_link(run, stage))

    def add_root(self, run: Path) -> None:
        """Note that ``run`` uses this store, so that `collect` keeps the results that it links to."""
        name = hashlib.sha256(str(run).encode()).hexdigest()[:16]
        note = self.root / ROOTS / name
        if not note.exists() and not self._only_readable():
            with disk_errors(note):
                note.parent.mkdir(parents=True, exist_ok=True)
                write_bytes(note, f"{run}\n".encode())

    def collect(
        self,
        stages: tuple[str, ...],
        *,
        checkpoints: bool,
        dry_run: bool,
        chosen: Collection[Path] | None = None,
    ) -> list[Garbage]:
        """Remove finished results that no run links to, and the remains of deleted folders. Return them.

        With ``checkpoints``, unfinished work and the cache of results per item are removed too. Only names of
        the form that the store gives are removed, and of these only the ``chosen`` ones. ``dry_run`` removes
        nothing. Raises StoreError if a process uses the store, or if the file system cannot tell.
        """
        with file_lock(self.root / "locks" / "store.lock", wait=False) as locked:
            if locked is False:
                raise StoreError("a run is using this store", hint="try again when the run has ended")
            if locked is None and not dry_run:
                raise StoreError(
                    f"the file system of {self.root} has no locks, which would protect data in use",
                    hint="when no run uses the store, delete the folders that --dry-run lists",
                )
            runs = [self.root.parent] if self.root.name == STORE_FOLDER else []
            for note in (self.root / ROOTS).glob("*"):
                with suppress(*FAULTS):
                    runs.append(Path(read_bytes(note, 65_536, root=self.root).decode().rstrip("\n")))
            links = [run / stage for run in runs for stage in stages]
            linked = {link.resolve() for link in links if link.is_symlink()}
            copies = ((link.name, key) for link in links if (key := copied_key(link)) is not None)
            linked |= {self.folder(stage, key).resolve() for stage, key in copies}
            folders: list[tuple[Path, Kind]] = [
                (folder, "finished")
                for stage in stages
                for folder in sorted((self.root / stage).glob("*"))
                if re.fullmatch(_KEY, folder.name) and folder.resolve() not in linked
            ]
            for folder in sorted((self.root / "work").glob("*")):
                if _RUBBISH.fullmatch(folder.name) or _WORK.fullmatch(folder.name):
                    folders.append((folder, "rubbish" if folder.name.startswith(".") else "unfinished"))
            for folder in sorted(self.root / "kept" / stage for stage in stages):
                if has_only_files(folder) and all(map(_is_cached, folder.iterdir())):
                    folders.append((folder, "kept"))
            found = [
                Garbage(folder, kind, size_of(folder))
                for folder, kind in folders
                if (checkpoints or kind in ("finished", "rubbish")) and (chosen is None or folder in chosen)
            ]
            if not dry_run:
                for garbage in found:
                    self.discard(garbage.folder)
                for lock in (self.root / "locks").glob("*.lock"):
                    if re.fullmatch(_KEY, lock.stem):
                        lock.unlink(missing_ok=True)
        return found


@dataclass(frozen=True)
class Garbage:
    """A folder that `Store.collect` may remove."""

    folder: Path
    kind: Kind
    bytes: int


def check_store(root: Path) -> None:
    """Check that ``root`` is a store, or that one may be made there.

    Raises InputError if it has content and is not a store, and StoreError if a link or a device is in it.
    """
    if root.name == STORE_FOLDER:
        refuse_links([root])
    if root.is_dir():
        refuse_links(root.iterdir())
        if (names := visible_names(root)) and not is_store(root):
            raise InputError(
                f"{root} is not empty and is not a store; it has {listed(names)}",
                hint=f"choose a new or empty folder, for example --store {root / 'store'}",
            )


def is_store(root: Path) -> bool:
    """Return True if ``root`` has a part that every store has."""
    return (
        (root / "locks" / "store.lock").is_file()
        or any(re.fullmatch(r"[0-9a-f]{16}", note.name) for note in (root / ROOTS).glob("*"))
        or any(re.fullmatch(_KEY, manifest.parent.name) for manifest in root.glob(f"*/*/{MANIFEST}"))
    )


def visible_names(folder: Path) -> list[str]:
    """Return the names in ``folder`` that are not hidden, those of folders with a slash at their ends."""
    places = sorted(folder.iterdir()) if folder.is_dir() else []
    shown = (place for place in places if not place.name.startswith(".") and place.name != "lost+found")
    return [f"{place.name}/" if place.is_dir() else place.name for place in shown]


def copied_key(link: Path) -> str | None:
    """Return the key of the results that ``RUN/<stage>`` is a copy of; None if it is something else."""
    try:
        key = None if link.is_symlink() else read_bytes(link / COPY, 100, root=link.parent).decode().strip()
    except FAULTS:
        return None
    return key if key and re.fullmatch(_KEY, key) else None


def writer_is_alive(work: Path) -> bool:
    """Return True if a process is using the work folder ``work``."""
    key = work.name.partition("@")[0].removesuffix(".forced")
    locks = work.parent.parent / "locks"
    linked = any(place.is_symlink() for place in (work.parent, work, locks))  # in a run of another person
    return not linked and work.is_dir() and is_locked(locks / f"{key}.lock")


def _is_cached(file: Path) -> bool:
    return is_partial(file) or _CACHED.fullmatch(file.name) is not None


def _keep_only(out: Path, patterns: Sequence[str]) -> None:
    """Delete everything in ``out`` except files that match a pattern, and their folders."""
    kept = {file for pattern in patterns for file in out.glob(pattern)}
    for place in sorted(out.rglob("*"), reverse=True):  # the content of a folder before the folder
        if place.is_dir() and not place.is_symlink():
            if not any(place.iterdir()):
                place.rmdir()
        elif place not in kept or not place.is_file() or is_partial(place):
            place.unlink()


def _link_files(source: Path, target: Path) -> None:
    """Link the files of ``source`` into the new folder ``target``; copy them where hard links are impossible.

    Links are safe, because stages replace files by rename and never write into an existing one. The final
    rename keeps a killed copy from being mistaken for a complete one.
    """
    temporary = target.with_name(f"{target.name}.carried")
    try:
        _each_file(os.link, source, temporary)
    except OSError:
        _each_file(shutil.copyfile, source, temporary)  # FAT32 refuses to copy permissions
    temporary.rename(target)


def _each_file(copy: Callable[[Path, Path], object], source: Path, target: Path) -> None:
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir()
    for file in regular_files(source):
        place = target / file.relative_to(source)
        place.parent.mkdir(parents=True, exist_ok=True)
        copy(file, place)
