"""The files of a report: their contents, and their safety against hostile names in a capture."""

from __future__ import annotations

import gzip
import json
import re
import shutil
from base64 import b64decode
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, cast

import numpy as np
import pytest
from pages import Page, assert_offline
from report_run import COUNT, HOSTILE, FinishedRun, wall

from cleargs.cli.report import outdated_report_note, write_run_report
from cleargs.digest import DigestMemo
from cleargs.errors import InputError
from cleargs.manifest import Manifest, linked_manifest, write_manifest
from cleargs.pipeline.config import load_config
from cleargs.pipeline.dag import installed
from cleargs.pipeline.runner import StageOutcome
from cleargs.pipeline.store import Store
from cleargs.report.frames import FrameRow
from cleargs.report.page import (
    changed_settings,
    command,
    frame_data,
    json_in_html,
    weight_colour,
    write_report,
)
from cleargs.report.report_json import LastRun, cameras_of, is_current, linked_manifests
from cleargs.report.verdict import ReportVerdict
from cleargs.report.web_scene import SCENE_BYTES, shown_degree, write_scene
from cleargs.rivr.tables import Selection


def test_a_frame_that_was_not_tried_says_why() -> None:
    frame: Any = SimpleNamespace(frame_id=3, name="c.png", registered=True, split="train")
    reason = "not tried: explained: blur 5.2 px"
    row = FrameRow(frame, rounds=(Selection.not_tried(3, reason),))
    data = frame_data(row, {}, None)
    assert (data["repair"], data["why"], data["scores"]) == ("none: the raw frame is kept", reason, {})


@pytest.mark.parametrize(
    ("poses", "errors", "expected"),
    [
        ("input", None, ("given", None, None)),
        ("input", {"given": 0.9, "adjusted": 0.8}, ("given", 0.9, 0.9)),
        ("refined", {"given": 1.7, "adjusted": 0.3}, ("adjusted", 1.7, 0.3)),
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
    with DigestMemo(root / "digests.sqlite") as memo:
        yield Store(root, memo)


@pytest.fixture(scope="module")
def page(run: FinishedRun, store: Store) -> Path:
    return write_report(run.planner(store), LastRun({"ingest": "found", "g0": "made"}, 1.25))


@pytest.fixture(scope="module")
def parsed(page: Path) -> Page:
    return Page(page.read_text())


def test_every_file_that_the_page_names_is_there(page: Path, parsed: Page) -> None:
    named = [image["src"] for image in parsed.all("img") if "src" in image]
    data = json.loads(re.search(r'id="data">(.*?)</script>', page.read_text(), re.S)[1])
    named += [path for frame in data["frames"] for path in frame["layers"].values()]
    named += ["viewer.js", "scene-before.js", "scene-after.js", "viewer-LICENSE.txt"]
    missing = [name for name in named if name and not (page.parent / name).is_file()]
    assert len(named) > 30 and not missing
    frames = {frame["id"]: frame for frame in data["frames"]}
    assert set(frames[0]["layers"]) == {"observed", "restored", "render", "final"}
    assert set(frames[5]["layers"]) == {"observed", "final"}  # no repair was tried
    assert set(frames[6]["layers"]) == {"observed"} and frames[6]["time"] is None  # it has no pose
    assert frames[0]["chosen"] == "restored" and frames[4]["chosen"] is None


def test_every_picture_says_what_it_shows(parsed: Page) -> None:
    pictures = [image for image in parsed.all("img") if "src" in image]
    assert len(pictures) == COUNT + 2 and all(image.get("alt") for image in pictures)
    drawings = [svg for svg in parsed.all("svg") if svg.get("aria-hidden") != "true"]
    assert len(drawings) == 1 + 3 + 3 and all(svg.get("aria-label") for svg in drawings)


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


def test_the_verdict_names_settings_that_exist(parsed: Page, run: FinishedRun) -> None:
    chips = [button["data-copy"] for button in parsed.all("button") if button.get("class") == "chip"]
    assert "--set ingest.holdout=every:8" in chips and "--set g0.steps=800" in chips
    sections = run.run.config.sections
    for chip in chips:
        section, _, name = str(chip).removeprefix("--set ").partition("=")[0].partition(".")
        assert name in type(sections[section]).model_fields
    assert "Fair: the first scene matches the best training frames reasonably well." in parsed.text
    assert "not repaired rose from 24.0 dB to 25.5 dB." in parsed.text
    assert "1 stretch of the path" in parsed.text


def test_settings_and_the_command_make_the_run_again(run: FinishedRun) -> None:
    changed = {name: (value, default) for name, value, default, _ in changed_settings(run.run.config)}
    assert changed["rva.tau_R"] == ("0.61", "0.7") and changed["rivr.distil.steps"] == ("100", "unset")
    assert command(run.run, run.dag) == (
        "cleargs run 'gone & <away>.mp4' -o run --workflow smoke --set rva.tau_R=0.61"
    )


def test_a_report_knows_whether_it_is_current(run: FinishedRun, store: Store, page: Path) -> None:
    manifests = linked_manifests(run.folder, run.dag.names)
    assert is_current(run.folder, manifests)
    other = manifests["g0"].model_copy(update={"key": "0" * 64})
    assert not is_current(run.folder, {**manifests, "g0": other})
    again = write_report(run.planner(store))  # keeps the record of the last run
    text = Page(again.read_text()).text
    assert "Peak memory of the last run: 1.2 GB." in text and "computed in the last run" in text
    assert not [path for path in run.folder.iterdir() if "partial" in path.name]


def test_a_run_ends_with_its_report(tmp_path: Path) -> None:
    run = FinishedRun(tmp_path)
    manifests = linked_manifests(run.folder, run.dag.names)

    def outcomes(how: Literal["made", "found"]) -> list[StageOutcome]:
        return [StageOutcome(name, how, manifest, run.folder / name) for name, manifest in manifests.items()]

    with DigestMemo(tmp_path / "digests.sqlite") as memo:
        planner = run.planner(Store(tmp_path, memo))
        page = write_run_report(planner, outcomes("found"))
        assert page == run.folder / "report/index.html" and "reused in the last run" in page.read_text()
        page.write_text("as it was")
        assert write_run_report(planner, outcomes("found")) == page and page.read_text() == "as it was"
        assert write_run_report(planner, outcomes("made")) == page
        assert "computed in the last run" in page.read_text()
        (run.folder / "consolidate/scene.ply").write_bytes(b"damaged")
        assert write_run_report(planner, outcomes("made")) is None  # the run itself has succeeded
        assert "computed in the last run" in page.read_text()  # the report before stays
        (run.folder / "ingest/manifest.json").unlink()
        assert write_run_report(planner, outcomes("found")) is None  # there is nothing to report on


def test_an_older_report_gets_a_note(tmp_path: Path) -> None:
    run = FinishedRun(tmp_path)
    assert outdated_report_note(run.folder, run.dag) == "", "there is none"
    with DigestMemo(tmp_path / "digests.sqlite") as memo:
        page = write_report(run.planner(Store(tmp_path, memo)))
    assert outdated_report_note(run.folder, run.dag) == ""
    (run.folder / "consolidate/manifest.json").unlink()
    line = outdated_report_note(run.folder, run.dag)
    assert line == f"note: {page} shows earlier results; update it with `cleargs report {run.folder}`"


def test_stages_that_the_run_does_not_show_are_left_out(tmp_path: Path) -> None:
    run = FinishedRun(tmp_path)
    for stage in ("g0", "rivr", "consolidate"):
        shutil.rmtree(run.folder / stage)
    with DigestMemo(tmp_path / "digests.sqlite") as memo:
        text = write_report(run.planner(Store(tmp_path, memo))).read_text()
    assert "No scene is trained yet" in text and is_current(
        run.folder, linked_manifests(run.folder, run.dag.names)
    )
    assert "none tried" in text and "the restored frame" not in text


def test_a_run_without_a_repair_claims_none(tmp_path: Path) -> None:
    run = FinishedRun(tmp_path)
    made = linked_manifest(run.folder, "consolidate")
    assert made is not None
    write_manifest(
        run.folder / "consolidate", made.model_copy(update={"summary": {**made.summary, "repairs": 0}})
    )
    with DigestMemo(tmp_path / "digests.sqlite") as memo:
        text = write_report(run.planner(Store(tmp_path, memo))).read_text()
    assert "No frame needed a repair." in text and "With the repairs" not in text


def test_a_run_that_is_not_finished_has_a_report_too(tmp_path: Path) -> None:
    run = FinishedRun(tmp_path)
    with DigestMemo(tmp_path / "digests.sqlite") as memo:
        for stage in ("rivr", "consolidate"):
            (run.folder / stage / "manifest.json").unlink()
        text = write_report(run.planner(Store(tmp_path, memo))).read_text()
        assert "no repair changed it" in text and "with repairs" not in text
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
    assert write_scene(tmp_path / "scene.js", "after", scene) == 2
    script = (tmp_path / "scene.js").read_bytes()
    packed = gzip.decompress(b64decode(script.split(b'"')[3]))
    assert b"element vertex 2000\n" in packed and len(script) < SCENE_BYTES


def test_weights_run_from_amber_to_teal() -> None:
    def rgb(weight: float) -> np.ndarray:
        return np.array([int(weight_colour(weight)[k : k + 2], 16) for k in (1, 3, 5)])

    assert rgb(0.0)[0] > 200 and rgb(1.0)[0] < 50 and (rgb(2.0) == rgb(1.0)).all()


def test_advice_is_only_what_can_help() -> None:
    def advice(frames: int, available: int, *settings: str) -> list[str]:
        lost = FrameRow(SimpleNamespace(registered=False))  # type: ignore[arg-type]
        manifests: Any = {"ingest": SimpleNamespace(summary={"frames_available": available}, missing=())}
        rows: Any = [lost] * frames
        verdict = ReportVerdict(manifests, rows, load_config(installed(), "default", settings))
        return list(next(verdict.warnings()).settings)

    assert advice(40, 40) == []  # every frame is used, and compared with every other
    assert advice(40, 60) == ["ingest.max_frames=60"]
    assert advice(40, 60, "ingest.fps=2") == ["ingest.fps=4"]
    assert advice(40, 40, "ingest.fps=2") == []  # images have no rate
    assert advice(150, 400) == ["ingest.max_frames=300", "ingest.overlap=16"]
