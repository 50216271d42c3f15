"""The files of a report: their contents, and their safety against hostile names in a capture."""

from __future__ import annotations

import gzip
import json
import re
import shutil
from base64 import b64decode
from collections.abc import Iterator
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, cast

import numpy as np
import pytest
from pages import Page, assert_offline
from report_run import COUNT, HOSTILE, FinishedRun, wall

from cleargs.cli.main import invoke
from cleargs.cli.report import outdated_report_note, write_run_report
from cleargs.digest import DigestMemo
from cleargs.errors import InputError
from cleargs.formation.movement import write_movement
from cleargs.manifest import Manifest, linked_manifest, write_manifest
from cleargs.media.image import write_mask
from cleargs.parquet import write_table
from cleargs.pipeline.runner import StageOutcome
from cleargs.pipeline.store import Store
from cleargs.progress import reporter_of
from cleargs.report.advice import command
from cleargs.report.frames import FrameRow, load_rows
from cleargs.report.html import json_in_html
from cleargs.report.page import write_report
from cleargs.report.page_data import changed_settings, frame_data, training_curves
from cleargs.report.pictures import FramePictures, ImageFile, layers_of
from cleargs.report.report_json import cameras_of, is_current, linked_manifests
from cleargs.report.single_file import single_file_size, write_single_file
from cleargs.report.web_scene import SCENE_BYTES, shown_degree, write_scene
from cleargs.rivr.tables import Selection
from cleargs.splat.tables import TRAIN


def test_a_frame_that_was_not_tried_says_why() -> None:
    frame: Any = SimpleNamespace(frame_id=3, name="c.png", registered=True, split="train")
    reason = "not tried: explained: blur 5.2 px"
    row = FrameRow(frame, rounds=(Selection.not_tried(3, reason),))
    data = frame_data(row, FramePictures(ImageFile("a.jpg", 1, 1), {}, None), None)
    assert (data["repair"], data["why"], data["scores"]) == ("kept as filmed", reason, {})
    assert data["chosen"] is None, "a frame that is kept as filmed has no repair that won"


@pytest.mark.parametrize(
    ("poses", "errors", "expected"),
    [
        ("given", None, ("given", None, None)),
        ("given", {"given": 0.9, "adjusted": 0.8}, ("given", 0.9, 0.9)),
        ("adjusted", {"given": 1.7, "adjusted": 0.3}, ("adjusted", 1.7, 0.3)),
        ("sfm", {"given": 1.7, "adjusted": 0.6, "sfm": 0.3}, ("sfm over given", 1.7, 0.3)),
        ("sfm", None, ("sfm", None, None)),
    ],
)
def test_the_report_says_how_cameras_were_placed(poses: str, errors: Any, expected: tuple[Any, ...]) -> None:
    lenses = [{"lens": "OPENCV", "focal_px": 518.0, "frames": 96}]
    summary = {"poses": poses, "kept_out_matches_off_px": errors, "cameras": lenses, "placed": {"given": 96}}
    found = cameras_of({"ingest": cast(Manifest, SimpleNamespace(summary=summary))})
    assert tuple(found[name] for name in ("method", "off_px_before", "off_px")) == expected
    assert found["lenses"] == lenses and cameras_of({}) == {}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    return FinishedRun(tmp_path_factory.mktemp("report"))


@pytest.fixture(scope="module")
def store(run: FinishedRun) -> Iterator[Store]:
    root = run.folder / ".store"
    root.mkdir()
    with DigestMemo(root / "digests.json") as memo:
        yield Store(root, memo)


@pytest.fixture(scope="module")
def page(run: FinishedRun, store: Store) -> Path:
    return write_report(run.planner(store))


@pytest.fixture(scope="module")
def parsed(page: Path) -> Page:
    return Page(page.read_text())


def test_every_file_that_the_page_names_is_there(page: Path, parsed: Page) -> None:
    named = [image["src"] for image in parsed.all("img") if "src" in image]
    data = json.loads(re.search(r'id="data">(.*?)</script>', page.read_text(), re.S)[1])
    named += [path for frame in data["frames"] for path in frame["layers"].values()]
    named += ["viewer.js", "scene.js", "viewer-LICENSE.txt"]
    missing = [name for name in named if name and not (page.parent / name).is_file()]
    assert len(named) > 30 and not missing
    frames = {frame["id"]: frame for frame in data["frames"]}
    assert set(frames[0]["layers"]) == {"observed", "restored", "render", "final"}
    assert set(frames[5]["layers"]) == {"observed", "final"}  # no repair was tried
    assert set(frames[6]["layers"]) == {"observed"} and frames[6]["time"] is None  # it has no pose
    assert frames[0]["chosen"] == "restored" and frames[4]["chosen"] is None


@pytest.mark.parametrize("script", ["report.js", "stage.js"])
def test_the_scripts_read_only_what_the_page_knows_of_a_frame(page: Path, script: str) -> None:
    data = json.loads(re.search(r'id="data">(.*?)</script>', page.read_text(), re.S)[1])
    source = files("cleargs.report").joinpath("static", script).read_text(encoding="utf-8")
    read = set(re.findall(r"\bframe\.(\w+)", source))
    assert read - {"id"} and read <= data["frames"][0].keys()


def test_every_picture_says_what_it_shows(parsed: Page) -> None:
    pictures = [image for image in parsed.all("img") if "src" in image]
    assert len(pictures) == COUNT + 5 + 1 and all(image.get("alt") for image in pictures)


def test_terms_mean_what_the_glossary_says(page: Path) -> None:
    glossary = (Path(__file__).parents[2] / "docs/glossary.md").read_text("utf-8")
    entries = dict(re.findall(r"### (.+)\n((?:.+\n)+)", glossary))
    terms = re.findall(r"<dt>([\w ]+)</dt><dd>([A-Z][^<]+\.)</dd>", page.read_text())
    assert {"R", "Role", "Gate"} <= dict(terms).keys()
    assert [name for name, text in terms if not " ".join(entries[name].split()).startswith(text)] == []


def test_nothing_is_loaded_from_a_network(page: Path) -> None:
    assert_offline(page)


def test_hostile_names_stay_text(page: Path, parsed: Page) -> None:
    assert all(name in parsed.text for name in HOSTILE)  # as text, whole
    assert len(parsed.all("script")) == 3 and "window.hacked = 1</script>" not in page.read_text()


def test_json_in_a_script_cannot_end_it() -> None:
    hostile = {"a": "</script><!-- <script> & \u2028", "nan": float("nan")}
    text = str(json_in_html(hostile))
    assert not set(text) & set("<>&\u2028")
    assert json.loads(text) == {"a": hostile["a"], "nan": None}


def test_settings_and_the_command_make_the_run_again(run: FinishedRun) -> None:
    changed = {name: (value, default) for name, value, default, _ in changed_settings(run.run.config)}
    assert changed["rva.tau_R"] == ("0.61", "0.7") and changed["rivr.distil.steps"] == ("100", "unset")
    assert command(run.run, run.dag) == (
        "cleargs run 'gone & <away>.mp4' -o run --recipe smoke --set rva.tau_R=0.61"
    )


def test_a_report_knows_whether_it_is_current(run: FinishedRun, store: Store, page: Path) -> None:
    manifests = linked_manifests(run.folder, run.dag.names)
    assert is_current(run.folder, manifests)
    other = manifests["g0"].model_copy(update={"key": "0" * 64})
    assert not is_current(run.folder, {**manifests, "g0": other})
    assert "Total time:" in page.read_text()
    assert not [path for path in run.folder.iterdir() if "partial" in path.name]


def test_a_run_ends_with_its_report(tmp_path: Path) -> None:
    run = FinishedRun(tmp_path)
    manifests = linked_manifests(run.folder, run.dag.names)

    def outcomes(how: Literal["made", "found"]) -> list[StageOutcome]:
        return [StageOutcome(name, how, manifest, run.folder / name) for name, manifest in manifests.items()]

    with DigestMemo(tmp_path / "digests.json") as memo:
        planner = run.planner(Store(tmp_path, memo))
        page = write_run_report(planner, outcomes("found"))
        assert page == run.folder / "report/index.html"
        page.write_text("as it was")
        assert write_run_report(planner, outcomes("found")) == page and page.read_text() == "as it was"
        assert write_run_report(planner, outcomes("made")) == page
        whole = page.read_text()
        assert whole != "as it was"
        (run.folder / "consolidate/scene.ply").write_bytes(b"damaged")
        assert write_run_report(planner, outcomes("made")) is None  # the run itself has succeeded
        assert page.read_text() == whole, "the report before stays"
        (run.folder / "ingest/manifest.json").unlink()
        assert write_run_report(planner, outcomes("found")) is None  # there is nothing to report on


def test_commands_start_with_the_program_as_the_user_called_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = FinishedRun(tmp_path)
    monkeypatch.setenv("CLEARGS_PROGRAM", f"{tmp_path}/.venv/bin/cleargs")
    with DigestMemo(tmp_path / "digests.json") as memo:
        text = write_report(run.planner(Store(tmp_path, memo))).read_text()
    commands = re.findall(r'data-copy="([^"]+)"', text)
    assert len(commands) >= 4 and all(one.startswith(".venv/bin/cleargs r") for one in commands)
    assert ".venv/bin/cleargs report run --single-file" in (run.folder / "report.html").read_text()
    write_single_file(run.folder / "report/index.html", tmp_path / "one.html")
    shared = re.findall(r'data-copy="([^"]+)"', (tmp_path / "one.html").read_text())
    assert len(shared) == len(commands) and all(one.startswith("cleargs r") for one in shared)


def test_an_older_report_gets_a_note(tmp_path: Path) -> None:
    run = FinishedRun(tmp_path)
    assert outdated_report_note(run.folder, run.dag) == "", "there is none"
    with DigestMemo(tmp_path / "digests.json") as memo:
        page = write_report(run.planner(Store(tmp_path, memo)))
    assert outdated_report_note(run.folder, run.dag) == ""
    (run.folder / "consolidate/manifest.json").unlink()
    line = outdated_report_note(run.folder, run.dag)
    assert line == f"note: {page} shows earlier results; update it with `cleargs report {run.folder}`"


def test_stages_that_the_run_does_not_show_are_left_out(tmp_path: Path) -> None:
    run = FinishedRun(tmp_path)
    for stage in ("g0", "rivr", "consolidate"):
        shutil.rmtree(run.folder / stage)
    with DigestMemo(tmp_path / "digests.json") as memo:
        text = write_report(run.planner(Store(tmp_path, memo))).read_text()
    assert "No scene is trained yet" in text and is_current(
        run.folder, linked_manifests(run.folder, run.dag.names)
    )
    assert "none tried" in text and "the restored frame" not in text and 'id="stage"' not in text


def test_a_run_without_a_repair_claims_none(tmp_path: Path) -> None:
    run = FinishedRun(tmp_path)
    made = linked_manifest(run.folder, "consolidate")
    assert made is not None
    write_manifest(
        run.folder / "consolidate", made.model_copy(update={"summary": {**made.summary, "repairs": 0}})
    )
    with DigestMemo(tmp_path / "digests.json") as memo:
        text = write_report(run.planner(Store(tmp_path, memo))).read_text()
    assert "0 repaired." in text


def test_the_curves_name_only_the_stages_that_trained(tmp_path: Path) -> None:
    """A draft trains once. Its report named all three trainings, one over the other."""
    run = FinishedRun(tmp_path)
    write_table(run.folder / "consolidate/train.parquet", TRAIN.empty_table(), TRAIN)
    found = training_curves(run.folder, ("g0", "consolidate"))
    assert found is not None and found["parts"] == [("g0", 0)]


def test_writing_a_report_is_announced(tmp_path: Path) -> None:
    """It takes seconds, on a busy machine more than ten of them."""
    run, lines = FinishedRun(tmp_path), list[str]()
    with DigestMemo(tmp_path / "digests.json") as memo:
        planner = run.planner(Store(tmp_path, memo))
        planner.reporter = reporter_of(lines.append)
        write_report(planner)
    assert "writing the report: started" in lines


def test_a_run_that_is_not_finished_has_a_report_too(tmp_path: Path) -> None:
    run = FinishedRun(tmp_path)
    with DigestMemo(tmp_path / "digests.json") as memo:
        for stage in ("rivr", "consolidate"):
            (run.folder / stage / "manifest.json").unlink()
        text = write_report(run.planner(Store(tmp_path, memo))).read_text()
        assert 'href="../g0/scene.ply"' in text and " repaired." not in text
        (run.folder / "g0/manifest.json").unlink()
        text = write_report(run.planner(Store(tmp_path, memo))).read_text()
        assert "No scene is trained yet" in text and 'id="stage"' not in text
        for stage in ("ingest", "rva"):
            (run.folder / stage / "manifest.json").unlink()
        with pytest.raises(InputError, match=r"no stage of .* is finished"):
            write_report(run.planner(Store(tmp_path, memo)))


def test_a_scene_in_a_report_is_bounded(tmp_path: Path) -> None:
    assert shown_degree(40_000, 3) == 3
    assert shown_degree(300_000, 3) == 1
    assert shown_degree(300_000, 0) == 0
    scene = wall(3, gaussians=3000, sh_degree=2)
    scene.gaussians.logit_opacities[:1000] = -8.0  # alpha 0.0003, stored as 0: nothing is lost
    assert write_scene(tmp_path / "scene.js", "scene", scene) == 2
    script = (tmp_path / "scene.js").read_bytes()
    packed = gzip.decompress(b64decode(script.split(b'"')[3]))
    assert b"element vertex 2000\n" in packed and len(script) < SCENE_BYTES


def test_the_run_folder_has_a_page_that_leads_to_the_report(page: Path) -> None:
    entry = page.parents[1] / "report.html"
    assert 'content="0; url=report/index.html"' in entry.read_text()
    assert (entry.parent / "report/index.html").samefile(page)


def test_a_report_in_one_file_has_all_images_and_the_scene_inside(page: Path, tmp_path: Path) -> None:
    target = tmp_path / "one.html"
    size = write_single_file(page, target)
    assert size == target.stat().st_size and size == pytest.approx(single_file_size(page.parent), rel=0.1)
    text = target.read_text()
    sources = [image["src"] for image in Page(text).all("img") if "src" in image]
    assert sources and all(str(source).startswith("data:image/jpeg;base64,") for source in sources)
    files = json.loads(re.search(r"window\.files = (.*);</script>", text)[1])
    data = json.loads(re.search(r'id="data">(.*?)</script>', text, re.S)[1])
    layers = {path for frame in data["frames"] for path in frame["layers"].values()}
    assert layers == files.keys()
    name = "frames/000000-final.jpg"
    assert b64decode(files[name].partition(",")[2]) == (page.parent / name).read_bytes()
    assert '["viewer"]' in text and '["scene"]' in text and "window.hacked = 1</script>" not in text


def test_the_report_shows_the_weight_with_which_a_frame_taught(run: FinishedRun) -> None:
    frame: Any = SimpleNamespace(frame_id=3, name="c.png", registered=True, split="train")
    rated = {"weight": 0.12, "role": "reactivated", "r_sharpness": 0.06}
    found = {"model": "blur", "blur_px": 11.3, "weight_before": 0.12, "weight_after": 1.0}
    row = FrameRow(frame, rated, formation=found)
    assert (row.weight, row.weight_text) == (1.0, "motion blur 11.3 px, simulated: counts fully")
    assert FrameRow(frame, rated).weight_text == "low sharpness 0.94: counts 12 %"
    assert FrameRow(frame, rated | {"weight": 0.0}).weight_text == "low sharpness 0.94: not used"
    held: Any = SimpleNamespace(registered=True, split="test")
    assert FrameRow(held).weight_text == "held out: not used"


def test_each_frame_has_the_psnr_of_its_last_steps(run: FinishedRun) -> None:
    rows = load_rows(run.folder, linked_manifests(run.folder, run.dag.names))
    # Step k of the last training shows frame k % 5 at 20 + 0.05 k dB; every third one is on a repair.
    steps = [[k for k in range(90) if k % 5 == frame and k % 3][-3:] for frame in range(5)]
    expected = [20.0 + 0.05 * of_frame[1] for of_frame in steps]
    assert [row.psnr for row in rows[:5]] == pytest.approx(expected)
    assert rows[5].psnr is None, "no training used it"


def test_held_out_frames_have_a_psnr_too(tmp_path: Path) -> None:
    run = FinishedRun(tmp_path, held_out=(0, 3))
    with DigestMemo(tmp_path / "digests.json") as memo:
        text = write_report(run.planner(Store(tmp_path, memo))).read_text()
    data = json.loads(re.search(r'id="data">(.*?)</script>', text, re.S)[1])
    assert all(frame["psnr"] > 5 for frame in data["frames"] if frame["role"] == "held out")
    assert "2 frames that were held out" in text


def test_what_moves_in_a_frame_is_a_layer(tmp_path: Path) -> None:
    run = FinishedRun(tmp_path)
    cells = np.arange(32) % 8 < 4  # the left half of 4 rows of 8 cells
    write_movement(run.folder / "consolidate/movement.parquet", {2: cells.reshape(4, 8)})
    row = load_rows(run.folder, linked_manifests(run.folder, run.dag.names))[2]
    layers = layers_of(row, run.folder)
    change = np.abs(layers["moving"].astype(int) - layers["observed"]).max(axis=2)
    assert (change[:, 48:] <= 1).all() and (change[:, :48] > 10).mean() > 0.9


def test_what_a_mask_leaves_out_is_a_layer(tmp_path: Path) -> None:
    run = FinishedRun(tmp_path)
    rows = load_rows(run.folder, linked_manifests(run.folder, run.dag.names))
    observed = layers_of(rows[2], run.folder)["observed"]
    (run.folder / "ingest/masks").mkdir()
    for mask in (np.full(observed.shape[:2], 255, np.uint8), np.zeros(observed.shape[:2], np.uint8)):
        mask[:, 48:] = 255
        write_mask(run.folder / "ingest/masks/000002.png", mask)
        row = replace(rows[2], frame=replace(rows[2].frame, mask="masks/000002.png"))
        layers = layers_of(row, run.folder)
        assert ("masked" in layers) == (not mask.all())
    change = np.abs(layers["masked"].astype(int) - layers["observed"]).max(axis=2)
    assert (change[:, 48:] <= 1).all() and (change[:, :48] > 10).mean() > 0.9


def test_the_command_writes_one_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = FinishedRun(tmp_path).folder
    assert invoke(["report", str(run), "-o", str(tmp_path / "a.html")]) == 2
    assert "--single-file" in capsys.readouterr().err and not (tmp_path / "a.html").exists()
    assert invoke(["report", str(run), "-q", "--single-file"]) == 0
    file = run / "run-report.html"
    assert f"written: {file} ({file.stat().st_size / 1e6:.1f} MB)" in capsys.readouterr().out
    (run / "report.html").unlink()
    assert invoke(["report", str(run), "-q"]) == 0
    assert capsys.readouterr().out == f"report: {(run / 'report.html').as_uri()}\n"
    assert (run / "report.html").is_file()
    assert invoke(["report", str(run), "--single-file", "--json", "-o", str(tmp_path / "a.html")]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["bytes"] == (tmp_path / "a.html").stat().st_size
