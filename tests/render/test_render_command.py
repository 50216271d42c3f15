"""``cleargs render``: stills, films, poses of a file, and errors."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import OpenImageIO
import pytest
from eval_world import HEIGHT, WIDTH, WORLD, cameras, make_scene, picture, to_input
from numpy.typing import NDArray

from cleargs.cli.main import invoke
from cleargs.errors import InputError
from cleargs.media.image import read_rgb
from cleargs.media.video import decode_frames, read_timeline
from cleargs.render.output import kind_of
from cleargs.render.paths import framed
from cleargs.render.shots import read_poses
from cleargs.splat.camera import cameras_json
from cleargs.splat.render import render as render_view


def render(run: Path, output: Path, *more: str) -> int:
    return invoke(["render", str(run), "-o", str(output), "-q", "--threads", "1", *more])


def film(path: Path) -> list[NDArray[np.uint8]]:
    return [image for _, image in decode_frames(path, read_timeline(path).pts)]


def exr(path: Path) -> dict[str, NDArray[np.float32]]:
    """Channels by name."""
    source = OpenImageIO.ImageInput.open(str(path))
    pixels, names = source.read_image(OpenImageIO.FLOAT), source.spec().channelnames
    source.close()
    return {name: pixels[..., index] for index, name in enumerate(names)}


def refusal(captured: pytest.CaptureFixture[str]) -> tuple[str, str]:
    cause, remedy = captured.readouterr().err.splitlines()
    return cause, remedy


# -- stills ------------------------------------------------------------------------------------------------


def test_a_still_is_what_the_scene_shows_at_the_frame(run: Path, tmp_path: Path) -> None:
    assert render(run, tmp_path / "new" / "still.png", "--frame", "4") == 0
    expected = picture(make_scene(), cameras()[4])
    # The quaternions of the table are those of the pose, except for rounding.
    difference = np.abs(read_rgb(tmp_path / "new" / "still.png").astype(int) - expected)
    assert 20 < expected.mean() < 235 and difference.max() <= 1
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["still.png"]


def test_without_a_frame_the_still_is_of_the_middle(run: Path, tmp_path: Path) -> None:
    assert render(run, tmp_path / "a.png") == 0 and render(run, tmp_path / "b.png", "--frame", "3") == 0
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_a_still_of_another_size(run: Path, tmp_path: Path) -> None:
    """With twice the height and three times the width, the middle shows the frame at twice its size."""
    assert render(run, tmp_path / "wide.png", "--frame", "2", "--size", f"{3 * WIDTH}x{2 * HEIGHT}") == 0
    wide = read_rgb(tmp_path / "wide.png")
    assert wide.shape == (2 * HEIGHT, 3 * WIDTH, 3)
    middle = wide[:, WIDTH // 2 : -WIDTH // 2].reshape(HEIGHT, 2, WIDTH, 2, 3).mean(axis=(1, 3))
    # Splats are dilated by a third of a pixel, so the larger image is a little sharper: it differs by 0.3
    # levels. The views of other frames differ by 29 or more.
    assert np.abs(middle - picture(make_scene(), cameras()[2])).mean() < 1


def test_an_exr_holds_light_alpha_and_depth(run: Path, tmp_path: Path) -> None:
    assert (
        render(run, tmp_path / "still.exr", "--frame", "1", "--size", f"400x{HEIGHT}") == 0
    )  # past the blobs
    layers = exr(tmp_path / "still.exr")
    assert set(layers) == {"R", "G", "B", "A", "Z"}
    truth = render_view(make_scene().gaussians, framed(cameras()[1], 400, HEIGHT))  # over black
    alpha, image = truth.alpha.numpy(), truth.image.numpy()
    assert alpha.min() == 0 and alpha.max() > 0.9
    linear = np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)
    light = np.stack([layers[name] for name in "RGB"], axis=-1)
    np.testing.assert_allclose(light, linear, rtol=2e-3, atol=1e-3)  # half floats, rounded quaternions
    np.testing.assert_allclose(layers["A"], alpha, atol=1e-3)
    seen = alpha > 0.9
    assert truth.depth is not None
    np.testing.assert_allclose(layers["Z"][seen], truth.depth.numpy()[seen] / alpha[seen], rtol=1e-4)
    assert 2.0 < layers["Z"][seen].min() < layers["Z"][seen].max() < 6.0  # blobs at z from 3 to 5
    assert (layers["Z"][alpha < 0.003] == 0).all()


# -- films -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("codec", ["h264", "av1"])
def test_a_film_has_its_length_frame_rate_and_size(run: Path, tmp_path: Path, codec: str) -> None:
    wanted = ["--fps", "12", "--seconds", "1.5", "--codec", codec, "--size", "128x96"]
    assert render(run, tmp_path / "film.mp4", *wanted) == 0
    timeline, pictures = read_timeline(tmp_path / "film.mp4"), film(tmp_path / "film.mp4")
    assert len(pictures) == 18 and pictures[0].shape == (96, 128, 3)
    assert timeline.seconds(17) == pytest.approx(17 / 12)
    # It begins at the first pose and ends at the last. The codec changes up to 1.7 levels. The next frame of
    # the capture differs by 25, the next frame of the film by 10.
    for shown, number in ((pictures[0], 0), (pictures[-1], 5)):
        assert render(run, tmp_path / f"{number}.png", "--frame", str(number), "--size", "128x96") == 0
        assert np.abs(shown.astype(float) - read_rgb(tmp_path / f"{number}.png")).mean() < 4
    assert np.abs(pictures[0].astype(float) - pictures[1]).mean() > 4


def test_side_by_side_has_the_nearest_frame_on_the_left(run: Path, tmp_path: Path) -> None:
    assert render(run, tmp_path / "both.mp4", "--side-by-side", "--fps", "4", "--seconds", "3") == 0
    pictures = film(tmp_path / "both.mp4")
    assert len(pictures) == 12 and pictures[0].shape == (HEIGHT, 2 * WIDTH, 3)
    raw = [read_rgb(run / f"ingest/images/{number:06d}.png").astype(float) for number in range(6)]
    differences = np.array([[np.abs(each[:, :WIDTH] - image).mean() for image in raw] for each in pictures])
    left = differences.argmin(axis=1)
    assert differences.min(axis=1).max() < 4  # 2.3 from the codec; other frames differ by 24
    assert left[0] == 0 and left[-1] == 5 and (np.diff(left) >= 0).all() and set(left) == set(range(6))
    # The render at the pose of this frame shows the same.
    assert np.abs(pictures[0][:, WIDTH:] - raw[0]).mean() < 4


def test_side_by_side_of_a_still_is_not_stretched(run: Path, tmp_path: Path) -> None:
    size = f"{2 * WIDTH}x{HEIGHT}"
    assert render(run, tmp_path / "s.png", "--frame", "0", "--side-by-side", "--size", size) == 0
    left = read_rgb(tmp_path / "s.png")[:, : 2 * WIDTH]
    raw = read_rgb(run / "ingest/images/000000.png")
    np.testing.assert_array_equal(left[:, WIDTH // 2 : WIDTH // 2 + WIDTH], raw)
    assert (left[:, : WIDTH // 2] == 0).all() and (left[:, WIDTH // 2 + WIDTH :] == 0).all()


def test_a_turntable_comes_back(run: Path, tmp_path: Path) -> None:
    """The capture saw its scene from one side, so the path goes back and forth, and can loop."""
    assert render(run, tmp_path / "turn" / "%02d.png", "--turntable", "--fps", "10", "--seconds", "2") == 0
    files = sorted((tmp_path / "turn").glob("*.png"))
    assert [file.name for file in files] == [f"{number:02d}.png" for number in range(20)]
    positions = np.array(
        [entry["position"] for entry in json.loads((tmp_path / "turn/cameras.json").read_text())]
    )
    steps = np.linalg.norm(positions - np.roll(positions, 1, axis=0), axis=1)
    # No step is longer than the longest step of a sine with 20 samples, and the path is slow at its ends.
    assert steps.max() < 1.1 * np.pi / 20 * np.linalg.norm(np.ptp(positions, axis=0))
    assert steps.min() < 0.5 * steps.max() and steps[0] <= steps.max()


# -- poses of a file ---------------------------------------------------------------------------------------


def test_poses_that_were_written_give_the_same_images(run: Path, tmp_path: Path) -> None:
    views = [cameras()[4], cameras()[1]]
    named = [(f"{number}", view) for number, view in enumerate(views)]
    (tmp_path / "cameras.json").write_text(json.dumps(cameras_json(named)))
    transforms = {"frames": [{"transform_matrix": to_input(view).tolist()} for view in views]}
    (tmp_path / "transforms.json").write_text(json.dumps(transforms))
    moved = cameras_json(named, scale=WORLD.scale, rotation=WORLD.rotation.T, translation=WORLD.origin)
    (tmp_path / "input.json").write_text(json.dumps(moved))
    for number, (name, more) in enumerate(
        [("cameras.json", []), ("transforms.json", []), ("input.json", ["--world", "input"])]
    ):
        assert render(run, tmp_path / f"out{number}" / "%d.png", "--poses", str(tmp_path / name), *more) == 0
        for index, view in enumerate(views):
            made = read_rgb(tmp_path / f"out{number}" / f"{index}.png").astype(int)
            assert np.abs(made - picture(make_scene(), view)).max() <= 2  # rounding


def test_poses_of_another_world_get_a_warning(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without poses in the input, the world of a run fits no other file: the pictures were black."""
    (tmp_path / "transforms.json").write_text(
        json.dumps({"frames": [{"transform_matrix": np.eye(4).tolist()}]})
    )
    (tmp_path / "cameras.json").write_text(json.dumps(cameras_json([("0", cameras()[0])])))
    for poses, errors in (("sfm", None), ("sfm", {"given": 1.0}), ("given", None)):
        warned = poses == "sfm" and errors is None
        found = SimpleNamespace(summary={"poses": poses, "kept_out_matches_off_px": errors})
        monkeypatch.setattr("cleargs.render.shots.linked_manifest", lambda run, stage, found=found: found)
        for file in ("transforms.json", "cameras.json"):
            words = ("--poses", str(tmp_path / file), "--force")
            assert render(run, tmp_path / "a.png", *words) == 0
            assert ("do not fit" in capsys.readouterr().err) is (warned and file == "transforms.json")


def test_the_lens_of_a_file_replaces_that_of_the_capture(tmp_path: Path) -> None:
    lens, pose = cameras()[0], np.eye(4).tolist()
    document: dict[str, Any] = {"w": 200, "h": 100, "camera_angle_x": np.pi / 2, "frames": [
        {"transform_matrix": pose}, {"transform_matrix": pose, "fl_x": 70.0, "cx": 90.0},
    ]}  # fmt: skip
    (tmp_path / "t.json").write_text(json.dumps(document))
    first, second = read_poses(tmp_path / "t.json", lens, WORLD)
    assert (first.width, first.height, first.cx, first.cy) == (200, 100, 100, 50)
    assert first.fx == first.fy == pytest.approx(100) and (second.fx, second.fy, second.cx) == (70, 70, 90)


@pytest.mark.parametrize(
    "document",
    ["{", "{}", "[]", '{"frames": []}', '{"frames": [{}]}', '{"frames": 3}', "3", "null", '[{"position": 1}]',
     '{"frames": [{"transform_matrix": [[1, 2], [3, 4]]}]}', '{"frames": ["x"]}',
     '[{"rotation": [[1,0,0],[0,1,0],[0,0,-1]], "position": [0,0,0]}]',
     '[{"rotation": [[1,0,0],[0,1,0],[0,0,NaN]], "position": [0,0,0]}]',
     '[{"rotation": [[1,0,0],[0,1,0],[0,0,1]], "position": [0,0,0], "width": 0}]',
     '[{"rotation": [[1,0,0],[0,1,0],[0,0,1]], "position": [0,0,0], "fx": -1}]'],
)  # fmt: skip
def test_a_file_without_poses_is_refused(tmp_path: Path, document: str) -> None:
    (tmp_path / "poses.json").write_text(document)
    with pytest.raises(InputError, match=r"poses\.json"):
        read_poses(tmp_path / "poses.json", cameras()[0], WORLD)


# -- errors ------------------------------------------------------------------------------------------------


def test_the_ending_selects_the_kind_of_output() -> None:
    kinds = {
        "a.mp4": "film",
        "a.PNG": "still",
        "a.exr": "still",
        "a/%04d.exr": "folder",
        "a/x%dy.png": "folder",
    }
    assert {name: kind_of(Path(name)) for name in kinds} == kinds
    for name in ("a", "a.mov", "a.jpg", "a/%d%d.png", "%03d.mp4"):
        with pytest.raises(InputError, match="no ending of a film or a still"):
            kind_of(Path(name))


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("a.mp4", ["--frame", "1"], "--frame is a still"),
        ("a.png", ["--frame", "99"], "frame 99 is not in this capture"),
        ("a.png", ["--frame", "1", "--turntable"], "give one of them"),
        ("a.png", ["--turntable"], "a.png can store only one image, not "),
        ("new/a.mp4", ["--size", "95x54"], "even width"),
        ("a.mp4", ["--size", "wide"], "WIDTHxHEIGHT"),
        ("a.mp4", ["--turntable", "--side-by-side"], "follow the path"),
        ("a.exr", ["--frame", "1", "--side-by-side"], "films and PNGs"),
        ("a.mp4", ["--world", "input"], "--poses"),
        ("a.png", ["--frame", "1", "--seconds", "3"], "length of the path"),
        ("a.png", ["--stage", "rva"], "rva has no scene"),
        ("a.gif", [], "no ending of a film"),
    ],
)
def test_wrong_options_are_errors_with_a_hint(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, options: list[str], words: str
) -> None:
    assert render(run, tmp_path / name, *options) == 2
    assert words in " ".join(refusal(capsys)) and not list(tmp_path.iterdir())


def test_existing_files_stay(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.png").write_text("mine")
    (tmp_path / "shots").mkdir()
    for output in (tmp_path / "mine.png", tmp_path / "shots" / "%02d.png"):
        assert render(run, output, "--fps", "2", "--seconds", "1") == 2
        assert "exists already" in refusal(capsys)[0]
    assert (tmp_path / "mine.png").read_text() == "mine" and not list((tmp_path / "shots").iterdir())
    assert render(run, tmp_path / "mine.png", "--force") == 0
    assert read_rgb(tmp_path / "mine.png").shape == (HEIGHT, WIDTH, 3)
    assert render(run, tmp_path / "shots" / "%02d.png", "--force", "--fps", "2", "--seconds", "1") == 2


def test_an_interrupted_render_leaves_nothing(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from cleargs.render.output import ShotRenderer

    original = ShotRenderer.picture
    rendered: list[Any] = []

    def interrupted(self: ShotRenderer, shot: Any) -> Any:
        rendered.append(shot)
        if len(rendered) == 4:
            raise KeyboardInterrupt
        return original(self, shot)

    monkeypatch.setattr(ShotRenderer, "picture", interrupted)
    for output in (tmp_path / "film.mp4", tmp_path / "shots" / "%02d.png"):
        rendered.clear()
        assert render(run, output, "--fps", "5", "--seconds", "2") == 130
        assert not list(tmp_path.iterdir())


def test_a_scene_file_is_rendered_at_given_poses(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The pictures are those of the run, at the poses that its export wrote."""
    document = cameras_json([(str(index), camera) for index, camera in enumerate(cameras())])
    (tmp_path / "cameras.json").write_text(json.dumps(document))
    shutil.copy(run / "g0" / "scene.ply", tmp_path / "other.ply")
    poses = ["--poses", str(tmp_path / "cameras.json")]
    assert render(run, tmp_path / "run" / "%d.png", *poses) == 0
    assert render(tmp_path / "other.ply", tmp_path / "file" / "%d.png", *poses) == 0
    for name in ("0.png", "5.png"):
        assert np.array_equal(read_rgb(tmp_path / "run" / name), read_rgb(tmp_path / "file" / name))
    assert render(tmp_path / "other.ply", tmp_path / "x.mp4") == 2
    assert "--poses" in capsys.readouterr().err
