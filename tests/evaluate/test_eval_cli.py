"""``cleargs eval`` as a user meets it: scenes, files, JSON, and every kind of bad input."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from eval_world import (
    WORLD,
    add_scene,
    cameras,
    make_scene,
    note_finished,
    picture,
    turned,
    write_reference,
    write_run,
)

from cleargs.capture.tables import FRAMES
from cleargs.cli.main import invoke
from cleargs.media.image import read_rgb, write_rgb
from cleargs.parquet import write_table
from cleargs.splat.formats import write_scene
from cleargs.splat.transforms import transform_scene

Shell = Callable[..., tuple[int, str, str]]

FAST = ("--lpips", "none", "--scorers", "none", "--threads", "1", "-q")


@pytest.fixture
def shell(capsys: pytest.CaptureFixture[str]) -> Shell:
    def call(*arguments: object) -> tuple[int, str, str]:
        code = invoke(["eval", *map(str, arguments)])
        streams = capsys.readouterr()
        return code, streams.out, streams.err

    return call


@pytest.fixture
def run(tmp_path: Path) -> Path:
    run = write_run(tmp_path / "run", make_scene(), cameras(), test=[2])
    add_scene(run, "rivr", make_scene(seed=1))
    return run


@pytest.fixture
def truth(tmp_path: Path) -> Path:
    return write_reference(tmp_path / "truth", make_scene(), cameras())


def fails(result: tuple[int, str, str], *words: str) -> None:
    """The command ended with code 2, one line of cause (with these words) and one of remedy."""
    code, _, errors = result
    lines = errors.strip().splitlines()
    assert code == 2 and len(lines) == 2, errors
    assert lines[0].startswith("error: ") and lines[1].startswith("hint: ")
    for word in words:
        assert word in lines[0]


def test_the_last_scene_of_a_run(shell: Shell, run: Path, truth: Path) -> None:
    code, out, _ = shell(run, "--reference", truth, *FAST)
    assert code == 0 and "rivr" in out and "g0" not in out
    document = json.loads((run / "eval" / "truth" / "eval.json").read_text())
    assert [found["subject"] for found in document["evaluations"]] == ["rivr"]
    assert (run / "eval" / "truth" / "eval.parquet").is_file()


def test_all_stages_as_json(shell: Shell, run: Path, truth: Path, tmp_path: Path) -> None:
    code, out, _ = shell(
        run, "--reference", truth, "--stage", "all", "--json", "--save-renders", tmp_path / "png", *FAST
    )
    g0, rivr = json.loads(out)["evaluations"]
    assert code == 0 and (g0["subject"], rivr["subject"]) == ("g0", "rivr")
    assert float(g0["means"]["psnr"]) > 58 > 25 > rivr["means"]["psnr"]
    assert g0["split"] == rivr["split"] and g0["scene"] != rivr["scene"]
    assert len(list((tmp_path / "png" / "g0").glob("*.png"))) == 6


def test_held_out_frames(shell: Shell, run: Path) -> None:
    code, out, _ = shell(run, "--stage", "g0", *FAST)
    assert code == 0 and "mean of 1" in out
    assert (run / "eval" / "holdout" / "eval.json").is_file()


@pytest.mark.parametrize("kind", ["ply", "sog", "glb", "compressed.ply"])
def test_scenes_in_other_formats(kind: str, shell: Shell, run: Path, truth: Path, tmp_path: Path) -> None:
    there = {"scale": WORLD.scale, "rotation": WORLD.rotation.T, "translation": WORLD.origin}
    write_scene(tmp_path / f"a.{kind}", transform_scene(make_scene(), **there), kind)
    code, out, _ = shell(tmp_path / f"a.{kind}", "--reference", truth, "--json", *FAST)
    assert (
        code == 0 and float(json.loads(out)["evaluations"][0]["means"]["psnr"]) > 38
    )  # 39.4; only .ply keeps the background


def test_given_poses_have_a_place_of_their_own(shell: Shell, run: Path, truth: Path) -> None:
    assert shell(run, "--reference", truth, "--poses", "given", *FAST)[0] == 0
    assert (run / "eval" / "truth-given" / "eval.json").is_file()


def test_refined_poses_are_a_second_figure(shell: Shell, tmp_path: Path) -> None:
    """The figures at the given poses stay, in the table and in the JSON."""
    scene = make_scene()
    run = write_run(tmp_path / "run", scene, [turned(camera, 1.0) for camera in cameras(3)])
    truth = write_reference(tmp_path / "truth", scene, cameras(3))
    options = (run, "--reference", truth, "--poses", "given", "--refine-poses", "8", *FAST)
    _, table, _ = shell(*options)
    assert len([line for line in table.splitlines() if "mean of 3" in line]) == 2
    assert "g0, poses refined" in table
    plain, refined = json.loads(shell(*options, "--json")[1])["evaluations"]
    assert (plain["options"]["refine_poses"], refined["options"]["refine_poses"]) == (0, 8)
    # A degree is 10 px of these cameras.
    assert plain["means"]["psnr"] < 35 < 45 < refined["means"]["psnr"]


def test_a_scene_file_and_renders(shell: Shell, run: Path, truth: Path, tmp_path: Path) -> None:
    result = tmp_path / "found.json"
    code, out, _ = shell(run / "g0" / "scene.ply", "--reference", truth, "-o", result, "--json", *FAST)
    assert code == 0 and json.loads(out) == json.loads(result.read_text())
    code, out, _ = shell("--renders", truth / "images", "--reference", truth, "--json", *FAST)
    assert code == 0 and json.loads(out)["evaluations"][0]["means"]["psnr"] == "Infinity"


def test_metrics_that_are_not_installed(
    shell: Shell, run: Path, truth: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CLEARGS_MODELS", str(tmp_path / "none"))
    code, out, _ = shell(run, "--reference", truth, "--threads", "1", "-q")
    assert (
        code == 0 and "lpips_alex, lpips_vgg: not installed: run `cleargs models install lpips` once" in out
    )
    assert out.count("models install lpips") == 1  # one line for both
    document = json.loads((run / "eval" / "truth" / "eval.json").read_text())["evaluations"][0]
    assert document["means"]["lpips_alex"] is None and document["means"]["clarity-net"] is not None


def test_one_figure_per_line(shell: Shell, run: Path, truth: Path) -> None:
    """All figures next to the table were one line of 200 letters, which ended in "dB from black"."""
    _, out, _ = shell(run, "--reference", truth, *FAST)
    _, _, after = out.partition("\nrivr:\n")
    lines = after.splitlines()
    assert [
        line.partition(":")[0] for line in lines if line.startswith("  over") or "background" in line
    ] == ["  over white", "  its background against white"]
    assert all(len(line) <= 80 and line.count(" dB") <= 1 for line in lines if line.startswith("  "))


def test_a_scene_says_how_many_of_its_views_it_was_trained_on(shell: Shell, run: Path, truth: Path) -> None:
    # Other frames are held out than those that the scene of g0 was not trained on.
    frames = pq.read_table(run / "ingest" / "frames.parquet").to_pylist()
    for row in frames:
        row["split"] = "test" if row["frame_id"] in (2, 4) else "train"
    write_table(run / "ingest" / "frames.parquet", pa.Table.from_pylist(frames, FRAMES), FRAMES)
    note_finished(run, "ingest", {"poses": "given"})
    code, out, _ = shell(run, "--stage", "g0", *FAST)
    assert code == 0 and out.startswith("note: 1 of 2 views are of frames that the scene was trained on\n")
    found = json.loads((run / "eval" / "holdout" / "eval.json").read_text())["evaluations"][0]
    assert found["trained_on"] == 1


def test_views_of_frames_that_were_trained_on_are_told_from_others(
    shell: Shell, run: Path, truth: Path, tmp_path: Path
) -> None:
    _, out, _ = shell(run, "--reference", truth, *FAST)
    assert out.startswith("note: 5 of 6 views are of frames that the scene was trained on\n")
    # Equal stems at other poses are other views.
    novel = write_reference(tmp_path / "novel", make_scene(), [turned(view, 4.0) for view in cameras()])
    _, out, _ = shell(run, "--reference", novel, *FAST)
    assert "trained on" not in out
    _, out, _ = shell(run / "g0" / "scene.ply", "--reference", truth, *FAST)
    assert out.startswith("note: the frames of the scene's training are not known\n")


def test_an_evaluation_stays_beside_those_of_other_stages_and_options(
    shell: Shell, run: Path, truth: Path
) -> None:
    def noted() -> list[tuple[str, bool]]:
        document = json.loads((run / "eval" / "truth" / "eval.json").read_text())
        return [(found["subject"], found["options"]["align_colour"]) for found in document["evaluations"]]

    shell(run, "--reference", truth, "--stage", "g0", *FAST)
    shell(run, "--reference", truth, "--stage", "rivr", *FAST)
    shell(run, "--reference", truth, "--stage", "g0", "--align-colour", *FAST)
    shell(run, "--reference", truth, "--stage", "g0", *FAST)
    assert noted() == [("g0", False), ("g0", True), ("rivr", False)]
    rows = pq.read_table(run / "eval" / "truth" / "eval.parquet").to_pylist()
    assert [row["adjusted"] for row in rows[::6]] == ["nothing", "colours", "nothing"]
    shutil.rmtree(run / "rivr")  # rebuilt with other settings: its old figures no longer belong to it
    add_scene(run, "rivr", make_scene(seed=2))
    shell(run, "--reference", truth, "--stage", "g0", *FAST)
    assert noted() == [("g0", False), ("g0", True)]


# -- bad input ---------------------------------------------------------------------------------------------


def test_wrong_usage(shell: Shell, run: Path, truth: Path, tmp_path: Path) -> None:
    scene = run / "g0" / "scene.ply"
    fails(shell(), "nothing to evaluate")
    fails(shell(tmp_path / "nowhere", "--reference", truth), "does not exist")
    fails(shell(scene), "nothing to compare")
    fails(shell(truth, "--reference", truth), "no run")
    fails(shell(scene, "--reference", truth, "--poses", "given"), "need a run")
    fails(shell(run, "--poses", "given"), "--reference")
    fails(shell(run, "--stage", "consolidate", "--reference", truth), "consolidate has no scene")
    fails(shell(run, "--stage", "g00", "--reference", truth), "g00")
    fails(shell(scene, "--stage", "g0", "--reference", truth), "--stage")
    fails(shell(scene, "--renders", truth, "--reference", truth), "--renders")
    fails(shell(run, "--reference", truth, "-o", tmp_path / "result.txt"), ".json")
    fails(shell(run, "--reference", truth, "--scorers", "bestnet", "-q", "--threads", "1"), "bestnet")


def test_a_run_without_held_out_frames(shell: Shell, tmp_path: Path) -> None:
    run = write_run(tmp_path / "plain", make_scene(), cameras())
    code, _, errors = shell(run, *FAST)
    assert code == 2 and "held no frames out" in errors and "ingest.holdout" in errors


def test_not_a_splat(shell: Shell, truth: Path, tmp_path: Path) -> None:
    (tmp_path / "mesh.ply").write_text("ply\nformat ascii 1.0\nelement vertex 0\nend_header\n")
    fails(
        shell(tmp_path / "mesh.ply", "--reference", truth, *FAST), "mesh.ply", "is not a scene of Gaussians"
    )
    fails(shell(truth / "images" / "000.png", "--reference", truth, *FAST), "is not a scene of Gaussians")


def test_a_folder_that_is_no_reference(shell: Shell, run: Path, truth: Path, tmp_path: Path) -> None:
    fails(shell(run, "--reference", tmp_path / "nowhere", *FAST), "no transforms.json")
    (truth / "transforms.json").write_text('{"frames": []}')
    fails(shell(run, "--reference", truth, *FAST), "lists no frames")
    (truth / "transforms.json").write_text("{")
    fails(shell(run, "--reference", truth, *FAST), "transforms.json")


def test_other_names(shell: Shell, run: Path, truth: Path, tmp_path: Path) -> None:
    other = write_reference(
        tmp_path / "other", make_scene(), cameras(), names=[f"sharp_{i}" for i in range(6)]
    )
    fails(
        shell(run, "--reference", other, "--poses", "given", *FAST),
        "sharp_0, sharp_1",
        "000, 001",
        "6 in all",
    )
    fails(shell("--renders", other / "images", "--reference", truth, *FAST), "sharp_0, sharp_1", "000, 001")
    sfm = write_run(tmp_path / "sfm", make_scene(), cameras(), poses="sfm")
    fails(shell(sfm, "--reference", other, *FAST), "no stem matches")


def test_two_references_of_one_stem(shell: Shell, run: Path, truth: Path) -> None:
    shutil.copytree(truth / "images", truth / "more")
    document = json.loads((truth / "transforms.json").read_text())
    document["frames"].append({**document["frames"][0], "file_path": "more/000.png"})
    (truth / "transforms.json").write_text(json.dumps(document))
    fails(shell(run, "--reference", truth, *FAST), "two images are called 000")


def test_fewer_renders_than_references(shell: Shell, truth: Path, tmp_path: Path) -> None:
    (tmp_path / "few").mkdir()
    shutil.copy(truth / "images" / "003.png", tmp_path / "few")
    arguments = ("--renders", tmp_path / "few", "--reference", truth, "--lpips", "none", "--scorers", "none")
    code, _, errors = shell(*arguments, "--threads", "1", "-q")
    assert code == 0 and "1 of 6 references" in errors


def test_other_sizes(shell: Shell, run: Path, truth: Path, tmp_path: Path) -> None:
    small = tmp_path / "small"
    small.mkdir()
    write_rgb(small / "000.png", picture(make_scene(), cameras()[0].resized(48, 36)))
    fails(shell("--renders", small, "--reference", truth, *FAST), "48x36", "96x72")
    write_rgb(truth / "images" / "004.png", np.zeros((36, 48, 3), np.uint8))
    fails(shell(run, "--reference", truth, *FAST), "004.png", "48x36", "96x72")
    tiny = write_reference(tmp_path / "tiny", make_scene(), [c.resized(24, 18) for c in cameras()])
    fails(shell(run, "--reference", tiny, *FAST), "too small")


def test_unreadable_images(shell: Shell, run: Path, truth: Path) -> None:
    (truth / "images" / "005.png").write_bytes(b"no image")
    fails(shell(run, "--reference", truth, *FAST), "005.png")
    (truth / "images" / "005.png").unlink()
    fails(shell(run, "--reference", truth, *FAST), "005.png")


def test_nan_poses(shell: Shell, run: Path, truth: Path) -> None:
    text = (truth / "transforms.json").read_text()
    document = json.loads(text)
    document["frames"][1]["transform_matrix"][0][3] = float("nan")
    (truth / "transforms.json").write_text(json.dumps(document))
    fails(shell(run, "--reference", truth, *FAST), "001")


def test_cameras_on_a_line_align_nothing(shell: Shell, tmp_path: Path) -> None:
    row = [turned(cameras(1)[0], 2.0 * index) for index in range(4)]  # one centre, four directions
    sfm = write_run(tmp_path / "sfm", make_scene(), row, poses="sfm")
    folder = write_reference(tmp_path / "row", make_scene(), row, similarity=WORLD)
    fails(shell(sfm, "--reference", folder, *FAST), "line")


def test_novel_views_are_aligned_by_the_observed_ones(shell: Shell, tmp_path: Path) -> None:
    """Views off the path have the stems of other frames. Once, the worlds were aligned by these."""
    scene, views = make_scene(), cameras()
    sfm = write_run(tmp_path / "sfm", scene, views, poses="sfm")
    write_reference(tmp_path / "truth" / "observed", scene, views, similarity=WORLD)
    novel = write_reference(tmp_path / "truth" / "novel", scene, views[::-1], similarity=WORLD)
    code, out, _ = shell(sfm, "--reference", novel, *FAST)
    assert code == 0 and "residual 0.00%" in out
    (novel.parent / "observed").rename(tmp_path / "elsewhere")
    refused = shell(sfm, "--reference", novel, *FAST)
    fails(refused, "too large for a comparison")
    assert "--align DIR" in refused[2]


def test_exposures_that_differ_are_named(shell: Shell, run: Path, truth: Path) -> None:
    """The figure with the colours aligned is shown only where it differs."""
    given = (run, "--reference", truth, "--stage", "g0", *FAST)
    code, out, _ = shell(*given)
    assert code == 0 and "exposures differ" not in out
    for path in (truth / "images").iterdir():
        write_rgb(path, (0.7 * read_rgb(path)).astype(np.uint8))
    code, out, _ = shell(*given)
    assert code == 0 and "exposures differ" in out and "--align-colour" in out


def test_a_figure_below_its_limit_fails(shell: Shell, run: Path, truth: Path) -> None:
    given = (run, "--reference", truth, *FAST, "--fail-below")
    code, out, _ = shell(*given, "psnr=1")
    assert code == 0 and "PSNR" in out
    code, out, err = shell(*given, "psnr=200", "--fail-below", "ssim=0")
    assert code == 1 and "PSNR" in out and "below the limit: rivr: psnr" in err and "ssim" not in err
    assert "choose one of" in shell(*given, "psrn=20")[2]
