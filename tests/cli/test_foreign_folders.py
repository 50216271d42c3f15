"""Files of the user, or of a hostile sender, in the folders that commands write and clear."""

from __future__ import annotations

import errno
import json
import os
import shutil
import stat
import sys
from collections.abc import Callable
from pathlib import Path

import click
import pytest
from toy import Bench

from cleargs import digest
from cleargs.cli import main as main_module
from cleargs.cli.main import invoke
from cleargs.digest import files_under
from cleargs.files import disk_error, whole_folder
from cleargs.manifest import linked_manifest, read_manifest
from cleargs.own_files import leftovers
from cleargs.pipeline.live import running_stage

KEY = f"{7:064x}"


@pytest.fixture
def give(bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str]]:
    """Give a command on the toy run; return the exit code and all output."""
    recipe = tmp_path / "toy.toml"
    recipe.write_text("[square]\npower = 2\n")

    def give(*arguments: object) -> tuple[int, str]:
        words = list(map(str, arguments))
        if words[0] == "run":
            words += [str(bench.capture), "--no-report", "--recipe", str(recipe)]
        code = invoke(words, bench.dag)
        said = capsys.readouterr()
        return code, said.out + said.err

    return give


def tree(folder: Path) -> dict[str, bytes | None]:
    return {str(x.relative_to(folder)): x.read_bytes() if x.is_file() else None for x in folder.rglob("*")}


def write(path: Path, text: str = "years of work") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


# -- folders of the user -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["report/thesis.tex", "report.html", "run.log", "notes.txt", "eval/a.txt"])
@pytest.mark.parametrize("dry", [(), ("--dry-run",)])
def test_a_folder_with_other_content_is_no_run(
    give: Callable[..., tuple[int, str]], tmp_path: Path, name: str, dry: tuple[str, ...]
) -> None:
    write(tmp_path / "mine" / name)
    before = tree(tmp_path / "mine")
    code, said = give("run", "-o", tmp_path / "mine", *dry)
    assert code == 2 and name.split("/")[0] in said and f"-o {tmp_path / 'mine'}/" in said
    assert tree(tmp_path / "mine") == before


def test_a_folder_with_hidden_files_alone_may_become_a_run(
    give: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    write(tmp_path / "mine" / ".git" / "HEAD")
    write(tmp_path / "mine" / ".lock", "a lock of the user")
    assert give("run", "-o", tmp_path / "mine")[0] == 0
    assert (tmp_path / "mine" / ".lock").read_text() == "a lock of the user"


def test_a_store_with_other_content_is_refused(give: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    for name in ("work/thesis/t.tex", "kept/photos/p.jpg", "count/letters/l", "locks/door.lock"):
        write(tmp_path / "proj" / name)
    before = tree(tmp_path / "proj")
    for command in (["run", "-o", tmp_path / "rq"], ["gc"]):
        code, said = give(*command, "--store", tmp_path / "proj")
        assert code == 2 and "not a store" in said
    assert tree(tmp_path / "proj") == before


def test_gc_removes_only_names_of_the_store(give: Callable[..., tuple[int, str]], bench: Bench) -> None:
    """Also in a store that an older version made in a folder of the user."""
    bench.run("square.power=3")
    bench.run()
    theirs = ("work/thesis/t.tex", "kept/photos/p.jpg", "kept/square/p.jpg", "count/letters/l")
    for name in (*theirs, "locks/door.lock", f"work/{KEY}x/a", f"count/{KEY}.old/a"):
        write(bench.store / name)
    before = tree(bench.store)
    ours = (f"work/{KEY}/out/a", f"work/{KEY}.forced/a", f"work/{KEY}@host-1/a", f"work/.rubbish-{KEY}-1/a")
    for name in ours:
        write(bench.store / name)
    code, said = give("gc", bench.folder, "--checkpoints")
    assert code == 2 and "--yes" in said, "without a terminal, gc cannot ask"
    code, said = give("gc", bench.folder, "--checkpoints", "--yes")
    assert code == 0 and said.count("unfinished") == 3 and said.count("finished   ") >= 2
    left = tree(bench.store)
    assert not any(name in left for name in ours)
    gone = before.keys() - left.keys()
    assert all(name.startswith(("square/", "total/")) or name.endswith(".lock") for name in gone)
    assert "locks/door.lock" in left and {*theirs} <= left.keys()


@pytest.mark.parametrize("answer", [True, False])
def test_gc_lists_and_asks(
    give: Callable[..., tuple[int, str]], bench: Bench, monkeypatch: pytest.MonkeyPatch, answer: bool
) -> None:
    bench.run("square.power=3")
    bench.run()
    folders = set((bench.store / "square").iterdir())
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(click, "confirm", lambda text, err: answer)
    code, said = give("gc", bench.folder)
    assert code == 0 and "finished    square/" in said and "in total" in said
    assert ("nothing was removed" in said) is not answer
    assert (set((bench.store / "square").iterdir()) == folders) is not answer


# -- links of a sender (tests/planted_links.py tries all paths) ---------------------------------------------


def test_results_behind_a_foreign_link_are_not_used(bench: Bench) -> None:
    bench.run()
    folder = (bench.folder / "square").resolve()
    other = bench.root / "mine" / "square" / KEY
    shutil.copytree(folder, other)
    for target in (other.parent, Path(os.path.relpath(other, bench.folder)), bench.root / "mine"):
        (bench.folder / "square").unlink()
        (bench.folder / "square").symlink_to(target)
        assert linked_manifest(bench.folder, "square") is None
    (bench.folder / "square").unlink()
    (bench.folder / "square").symlink_to(other)
    assert linked_manifest(bench.folder, "square") is not None, "the form of a link of a store"
    (other / "powers" / "extra").symlink_to("/etc/passwd")
    assert linked_manifest(bench.folder, "square") is None


def test_a_manifest_that_names_files_outside_is_damaged(bench: Bench) -> None:
    bench.run()
    made = read_manifest(bench.folder / "total")
    from cleargs.manifest import write_manifest

    files = {"../../../secret": next(iter(made.files.values()))}
    write_manifest((bench.folder / "total").resolve(), made.model_copy(update={"files": files}))
    with pytest.raises(ValueError, match="damaged"):
        read_manifest(bench.folder / "total")


def test_a_fifo_in_the_place_of_results_is_replaced(bench: Bench) -> None:
    before = bench.digests()
    place = (bench.folder / "square").resolve()
    shutil.rmtree(place)
    os.mkfifo(place)
    assert bench.digests() == before and place.is_dir()


def test_the_store_of_a_run_may_not_be_a_link(give: Callable[..., tuple[int, str]], bench: Bench) -> None:
    bench.run()
    bench.store.rename(bench.root / "elsewhere")
    bench.store.symlink_to(bench.root / "elsewhere")
    code, said = give("gc", bench.folder, "--yes")
    assert code == 1 and f"{bench.store} is a link" in said


def test_a_run_keeps_its_log_next_to_a_backup_of_hard_links(
    give: Callable[..., tuple[int, str]], bench: Bench
) -> None:
    """``cp -al`` makes such a backup."""
    give("run", "-o", bench.folder)
    log = bench.folder / "run.log"
    backup = bench.root / "backup.log"
    backup.hardlink_to(log)
    before = log.read_bytes()
    assert give("run", "-o", bench.folder)[0] == 0
    assert (
        backup.read_bytes() == before
        and log.read_bytes().startswith(before)
        and len(before) < len(log.read_bytes())
    )


@pytest.mark.parametrize("command", ["status", "run"])
def test_a_run_of_another_does_not_make_commands_search_the_disk(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    """Its ``run.toml`` may name any folder as the input."""
    bench.run()
    home = write(bench.root / "home" / "0.txt").parent
    for index in range(30):
        write(home / f"{index}/{index}.txt")
    text = (bench.folder / "run.toml").read_text()
    write(bench.folder / "run.toml", text.replace(f'"{bench.capture}"', f'"{home}"'))
    monkeypatch.setattr(digest, "MAX_FILES", 20)
    assert invoke([command, str(bench.folder)], bench.dag) == 2
    assert "it is not one capture" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["w" * 5000, "..", "a/b", ""])
def test_a_progress_file_has_bounds(bench: Bench, name: str) -> None:
    bench.run()
    state = {"stage": "square", "work": name, "label": "square"}
    write(bench.folder / ".at_work.json", json.dumps(state))
    assert running_stage(bench.folder, bench.store) is None


# -- leftovers, odd disks, odd variables --------------------------------------------------------------------


def test_a_rubbish_name_that_is_taken_gets_another(bench: Bench) -> None:
    before = bench.digests()
    place = (bench.folder / "square").resolve()
    write(bench.store / "work" / f".rubbish-{place.name}-{os.getpid()}" / "left")
    next(place.glob("powers/*")).write_text("damaged")
    assert bench.digests() == before


def test_partial_folders_of_killed_processes_are_found(
    give: Callable[..., tuple[int, str]], bench: Bench, tmp_path: Path
) -> None:
    give("run", "-o", bench.folder)
    dead = bench.folder / ".0123abcd.partial.report"
    write(dead / "index.html")
    os.utime(dead, (0, 0))
    write(bench.folder / ".mine.partial.report" / "a")
    with whole_folder(bench.folder / "report") as alive:
        os.utime(alive, (0, 0))
        assert leftovers(bench.folder, "report") == [dead]
        code, said = give("gc", bench.folder, "--yes")
        assert code == 0 and "rubbish" in said
        assert not dead.exists() and alive.is_dir() and (bench.folder / ".mine.partial.report/a").is_file()


def test_gc_removes_partial_files_of_killed_processes(
    give: Callable[..., tuple[int, str]], bench: Bench
) -> None:
    give("run", "-o", bench.folder)
    places = (bench.folder, bench.store, bench.store / "roots")
    dead = [write(place / ".0123abcd.partial.run.toml") for place in places]
    written = write(bench.folder / ".0123abce.partial.film.mp4")
    mine = write(bench.folder / ".mine.partial.run.toml")
    for file in (*dead, mine):
        os.utime(file, (0, 0))
    assert give("gc", bench.folder, "--yes")[0] == 0
    assert not any(file.exists() for file in dead) and written.is_file() and mine.is_file()


def test_links_in_the_cache_of_a_stage_are_removed_before_it_runs(bench: Bench, tmp_path: Path) -> None:
    mine = write(tmp_path / "mine" / f"{1:064x}.json")
    kept = bench.store / "kept" / "square"
    cached = write(kept / f"{2:064x}.json", "{}")
    (kept / mine.name).symlink_to(mine)
    (bench.store / "kept" / "total").symlink_to(mine.parent)
    bench.run()
    assert not os.path.lexists(kept / mine.name) and not os.path.lexists(bench.store / "kept" / "total")
    assert cached.read_text() == "{}" and mine.read_text() == "years of work"


def test_loops_of_links_in_a_capture_end(tmp_path: Path) -> None:
    write(tmp_path / "sub" / "a.png")
    for name in ("x", "y", "sub/up1", "sub/up2"):
        (tmp_path / name).symlink_to(tmp_path)
    (tmp_path / "a link").symlink_to(tmp_path / "sub")
    assert list(files_under(tmp_path)) == ["sub/a.png"]
    (tmp_path.parent / f"{tmp_path.name}-far").mkdir()
    write(tmp_path.parent / f"{tmp_path.name}-far" / "b.png")
    (tmp_path / "far").symlink_to(tmp_path.parent / f"{tmp_path.name}-far")
    assert sorted(files_under(tmp_path)) == ["far/b.png", "sub/a.png"], "links to other folders are followed"


def test_a_disk_without_inodes_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full = os.statvfs(tmp_path)
    for inodes, cause in ((0, "(inodes) left"), (5, "no space left")):
        values = (*full[:3], 100, 100, 1000, inodes, inodes, *full[8:10])
        monkeypatch.setattr(os, "statvfs", lambda path, values=values: os.statvfs_result(values))
        assert cause in str(disk_error(OSError(errno.ENOSPC, ""), tmp_path / "a"))


@pytest.mark.parametrize("variable", ["SOURCE_DATE_EPOCH", "NOISYLIB_THREADS"])
def test_a_variable_that_a_library_cannot_use_is_named(
    variable: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads = f"os.environ['{variable}']" if variable.startswith("SOURCE") else "'x'"
    write(tmp_path / "site-packages/noisylib/__init__.py", f"import os\nint({reads})\n")
    monkeypatch.syspath_prepend(tmp_path / "site-packages")
    monkeypatch.setenv(variable, "x")
    with pytest.raises(ValueError) as raised:
        __import__("noisylib")
    code, cause, _ = main_module.explanation(raised.value)
    assert code == 2 and f"environment variable {variable}=x cannot be used" in cause
    monkeypatch.delenv(variable)
    assert main_module.explanation(ValueError("ours"))[1].startswith("unexpected ValueError")


def test_a_second_user_may_use_a_store_that_he_may_only_read(
    give: Callable[..., tuple[int, str]], bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As with umask 022: the folder is open to all, its parts belong to the first user."""
    store = tmp_path / "shared"
    assert give("run", "-o", bench.folder, "--store", store)[0] == 0
    parts = [*store.rglob("*")]
    access = os.access
    monkeypatch.setattr(
        os, "access", lambda path, mode: not (mode == os.W_OK and Path(path) in parts) and access(path, mode)
    )
    before = {path: path.stat().st_mtime_ns for path in parts if stat.S_ISREG(path.stat().st_mode)}
    code, said = give("run", "-o", tmp_path / "second", "--store", store)
    assert code == 0 and "reused: count, square, total" in said
    digests = store / "digests.json"
    assert {path: path.stat().st_mtime_ns for path in before if path != digests} == {
        path: time for path, time in before.items() if path != digests
    }
