"""The stage as a whole, on a small synthetic capture whose geometry is known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cleargs.capture.cameras import Intrinsics, Pose, pinhole
from cleargs.capture.model import read_model, write_model
from cleargs.capture.tables import Frame, load_frames, load_observations, load_points
from cleargs.errors import InputError, StageError

from .conftest import FOCAL, HEIGHT, PLANES, WIDTH, Ingest, Ingested, camera_to_world, write_transforms

TABLES = ("frames.parquet", "points.parquet", "observations.parquet")


def pose_of(frame: Frame) -> Pose:
    values = [frame.qw, frame.qx, frame.qy, frame.qz, frame.tx, frame.ty, frame.tz]
    numbers = np.array(values, np.float64)
    return Pose.from_quaternion(numbers[:4], numbers[4:])


def same_bytes(first: Path, second: Path) -> bool:
    files = [*TABLES, *(f"colmap/sparse/0/{name}.bin" for name in ("cameras", "images", "points3D"))]
    return all((first / name).read_bytes() == (second / name).read_bytes() for name in files)


def back_to_input(ingest: Path, xyz: np.ndarray) -> np.ndarray:
    world = json.loads((ingest / "world.json").read_text())
    scale, rotation, translation = (np.array(world[k]) for k in ("scale", "rotation", "translation"))
    return np.asarray(scale * xyz @ rotation.T + translation)


def errors_of_poses(out: Path) -> tuple[float, float]:
    """Largest error of turn, degrees, and of place, after the best similarity to the true cameras."""
    found = [pose_of(frame) for frame in load_frames(out)]
    truth = camera_to_world(10)
    centres = np.stack([pose.centre for pose in found])
    a, b = centres - centres.mean(axis=0), np.stack([pose[:3, 3] for pose in truth])
    b = b - b.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    d = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    turn = u @ d @ vt
    placed = (s * np.diag(d)).sum() / (a**2).sum() * a @ turn.T
    turns = [
        Rotation.from_matrix(turn @ pose.rotation.T @ true[:3, :3].T).magnitude()
        for pose, true in zip(found, truth, strict=True)
    ]
    return float(np.degrees(max(turns))), float(np.linalg.norm(placed - b, axis=1).max())


def test_given_poses_give_true_points(made: Ingested) -> None:
    frames, points = load_frames(made.out), load_points(made.out)
    summary = made.result.summary
    assert summary["poses"] == "given" and summary["registered"] == len(frames) == 10
    assert summary["given_poses_missed_px"] < 0.5
    centres = np.stack([pose_of(frame).centre for frame in frames])
    assert np.allclose(centres.mean(axis=0), 0, atol=1e-12)
    assert np.isclose(np.linalg.norm(centres, axis=1).max(), 1)
    up = -np.stack([pose_of(frame).rotation[1] for frame in frames]).mean(axis=0)
    assert np.allclose(up / np.linalg.norm(up), [0, -1, 0], atol=1e-12)

    # transforms.json speaks OpenGL cameras in the scene's own (OpenCV) world, so the way back ends in that.
    truth = np.stack([pose[:3, 3] for pose in camera_to_world(10)])
    assert np.allclose(back_to_input(made.out, centres), truth, atol=1e-9)
    world = back_to_input(made.out, points.xyz)
    distance = np.abs(world[:, 2:] - [depth for depth, *_ in PLANES]).min(axis=1)
    # Half a pixel at f = 300 over a 1 m baseline is about 2 cm at 4 m.
    assert len(points.xyz) > 200 and np.median(distance) < 0.01 and np.quantile(distance, 0.9) < 0.05


def test_observations_point_at_what_they_see(made: Ingested) -> None:
    done = made
    frames, points = load_frames(done.out), load_points(done.out)
    frame_ids, point_ids = load_observations(done.out)
    assert len(set(zip(frame_ids.tolist(), point_ids.tolist(), strict=True))) == len(frame_ids)
    assert [frame.n_points for frame in frames] == np.bincount(frame_ids, minlength=10).tolist()
    lengths = dict(zip(*np.unique(point_ids, return_counts=True), strict=True))
    assert [lengths[point] for point in points.point_id] == points.track_length.tolist()
    # The exported model of the undistorted world agrees: every observation lies where its point projects.
    model = read_model(done.out / "colmap" / "sparse" / "0")
    residuals = []
    for frame in frames:
        image = model.images[frame.frame_id + 1]
        assert image.name == Path(frame.image).name
        pose = pose_of(frame)
        xyz = points.xyz[np.searchsorted(points.point_id, image.point_ids)]
        camera = xyz @ pose.rotation.T + pose.translation
        uv = camera[:, :2] / camera[:, 2:] * [frame.fx, frame.fy] + [frame.cx, frame.cy]
        residuals.append(np.linalg.norm(uv - image.xy, axis=1))
    assert np.concatenate(residuals).mean() < 1
    # A point's colour is the mean over its frames: near the pixel of any of them on these matt planes.
    frame = frames[4]
    picture = cv2.imread(str(done.out / frame.image))[..., ::-1]
    seen = model.images[frame.frame_id + 1]
    x, y = seen.xy.astype(int).T
    rgb = points.rgb[np.searchsorted(points.point_id, seen.point_ids)]
    assert np.abs(picture[y, x].astype(int) - rgb).mean() < 15


@pytest.mark.parametrize(("scale", "shift"), [(1e4, 1e10), (1e-4, 0.0)])
def test_the_input_world_does_not_matter(
    posed: Path,
    made: Ingested,
    ingest: Ingest,
    frames: list[tuple[np.ndarray, np.ndarray]],
    scale: float,
    shift: float,
) -> None:
    moved = []
    for pose, _ in frames:
        matrix = pose.copy()
        matrix[:3, 3] = scale * matrix[:3, 3] + shift
        moved.append(matrix)
    write_transforms(posed, moved)
    other = ingest(posed, "moved")
    for one, two in zip(load_frames(made.out), load_frames(other.out), strict=True):
        assert np.allclose(pose_of(one).rotation, pose_of(two).rotation, atol=1e-5)
        assert np.allclose(pose_of(one).translation, pose_of(two).translation, atol=1e-5)
    first, second = load_points(made.out), load_points(other.out)
    assert np.array_equal(first.point_id, second.point_id)
    assert np.allclose(first.xyz, second.xyz, rtol=1e-5, atol=1e-5)
    assert np.array_equal(first.rgb, second.rgb)
    assert all(
        np.array_equal(a, b)
        for a, b in zip(load_observations(made.out), load_observations(other.out), strict=True)
    )


@pytest.fixture
def shaken(posed: Path) -> Path:
    """The capture with poses as of a headset: off by a degree and by a hundredth of the arc."""
    random = np.random.default_rng(3)
    poses = camera_to_world(10)
    for pose in poses:
        pose[:3, :3] = Rotation.from_rotvec(np.radians(random.normal(0, 0.7, 3))).as_matrix() @ pose[:3, :3]
        pose[:3, 3] += random.normal(0, 0.015, 3)
    write_transforms(posed, poses)
    return posed


def test_poses_that_the_images_contradict_are_adjusted(shaken: Path, ingest: Ingest) -> None:
    kept, adjusted = ingest(shaken, "kept", refine_above=100), ingest(shaken, "adjusted")
    assert kept.result.summary["poses"] == "given" and adjusted.result.summary["poses"] == "adjusted"
    assert (
        kept.result.summary["given_poses_missed_px"] == adjusted.result.summary["given_poses_missed_px"] > 1
    )
    assert [frame.registered for frame in load_frames(adjusted.out)] == [True] * 10
    assert {frame.placed for frame in load_frames(adjusted.out)} == {"adjusted"}
    off = [errors_of_poses(done.out) for done in (kept, adjusted)]
    # A feature lies within a few tenths of a pixel, which is a twentieth of a degree at f = 300; what is left
    # of 1.6 degrees and 0.026 is 0.04 and 0.003.
    assert off[0][0] > 0.5 and off[1][0] < 0.1
    assert off[0][1] > 0.015 and off[1][1] < 0.008
    assert len(load_points(adjusted.out).xyz) > len(load_points(kept.out).xyz)
    assert same_bytes(adjusted.out, ingest(shaken, "again", threads=2, kept="other").out)


def test_what_a_rolling_shutter_does_is_not_put_down_to_the_poses(posed: Path, ingest: Ingest) -> None:
    """The rows of each image swing back and forth, as under a camera that shakes while they are read."""
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    for index, path in enumerate(sorted((posed / "images").iterdir())):
        swing = 4 * np.sin(4 * np.pi * rows / HEIGHT + index)
        cv2.imwrite(str(path), cv2.remap(cv2.imread(str(path)), columns + swing, rows, cv2.INTER_LINEAR))
    done = ingest(posed)
    assert done.result.summary["given_poses_missed_px"] > 0.6
    assert done.result.summary["poses"] == "given" and errors_of_poses(done.out) < (1e-6, 1e-9)


def test_a_frame_without_features_keeps_its_pose_amid_an_adjustment(shaken: Path, ingest: Ingest) -> None:
    grey = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    cv2.imwrite(str(sorted((shaken / "images").iterdir())[4]), grey)
    kept, adjusted = ingest(shaken, "kept", refine_above=100), ingest(shaken, "adjusted")
    assert adjusted.result.summary["poses"] == "adjusted"
    (one, two) = (load_frames(done.out)[4] for done in (kept, adjusted))
    assert two.registered and two.n_points == 0
    assert np.allclose(pose_of(one).rotation, pose_of(two).rotation, atol=1e-12)
    assert np.allclose(pose_of(one).centre, pose_of(two).centre, atol=1e-12)


def test_poses_that_are_far_off_are_found_again(posed: Path, ingest: Ingest) -> None:
    """Adjusted from there, they end in a minimum whose cameras are 15 degrees off."""
    random = np.random.default_rng(3)
    poses = camera_to_world(10)
    for pose in poses:
        pose[:3, :3] = Rotation.from_rotvec(np.radians(random.normal(0, 4, 3))).as_matrix() @ pose[:3, :3]
    write_transforms(posed, poses)
    done = ingest(posed)
    summary = done.result.summary
    assert summary["given_poses_missed_px"] > 0.6 and summary["poses"] == "sfm"
    off = summary["kept_out_matches_off_px"]
    assert off["sfm"] < 0.5 * off["adjusted"] < 0.1 * off["given"]
    assert errors_of_poses(done.out) < (0.3, 0.05)
    assert {frame.placed for frame in load_frames(done.out)} == {"sfm"}
    # In the user's world: what is left is how far the given cameras are off themselves.
    centres = np.stack([pose_of(frame).centre for frame in load_frames(done.out)])
    truth = np.stack([pose[:3, 3] for pose in camera_to_world(10)])
    assert np.abs(back_to_input(done.out, centres) - truth).max() < 0.3


def test_a_sparse_model_of_bad_poses_is_adjusted_too(shaken: Path, ingest: Ingest) -> None:
    first = ingest(shaken, "first", refine_above=100)
    second = ingest(first.out, "second")
    assert second.result.summary["kind"] == "colmap" and second.result.summary["poses"] == "adjusted"
    assert errors_of_poses(second.out)[0] < 0.1


def test_errors_that_a_sparse_model_states_are_not_believed(first: Path, ingest: Ingest) -> None:
    """A program changed the camera afterwards. COLMAP stores errors and does not renew them."""
    folder = first / "colmap/sparse/0"
    model = read_model(folder)
    assert 0 < np.median(model.error) < 0.6 and np.median(model.misses()) < 0.6
    cameras = {
        key: pinhole(WIDTH, HEIGHT, 1.2 * camera.focal[0], 1.2 * camera.focal[1], *camera.centre)
        for key, camera in model.cameras.items()
    }
    write_model(folder, replace(model, cameras=cameras), np.zeros((len(model.point_ids), 3), np.uint8))
    assert np.median(read_model(folder).error) < 0.6 < np.median(read_model(folder).misses())
    kept, adjusted = ingest(first, "kept"), ingest(first, "adjusted", refine_above=0.3)
    assert [done.result.summary["kind"] for done in (kept, adjusted)] == ["colmap", "colmap"]
    # 0.6 px is less than what other points miss at this camera. They replace those of the input.
    assert kept.result.summary["poses"] == "given"
    published = read_model(kept.out / "colmap/sparse/0")
    assert np.median(published.misses()) < 0.6 and np.median(published.error) > np.median(model.error)
    assert adjusted.result.summary["poses"] in ("adjusted", "sfm")
    assert all(abs(frame.fx / FOCAL - 1) < 0.02 for frame in load_frames(adjusted.out))


def test_a_sparse_model_keeps_its_points_where_other_poses_are_no_better(
    made: Ingested, ingest: Ingest
) -> None:
    second = ingest(made.out, "second", refine_above=0, max_features=512)  # would triangulate fewer points
    assert second.result.summary["poses"] == "given"
    one, two = load_points(made.out), load_points(second.out)
    assert np.array_equal(one.point_id, two.point_id) and np.allclose(one.xyz, two.xyz, atol=1e-9)


def test_sfm_finds_the_arc(images: Path, placed: Ingested, ingest: Ingest) -> None:
    done = ingest(images, "sfm", threads=2)
    frames = load_frames(done.out)
    assert [frame.name for frame in frames] == [f"view{index}.png" for index in range(10)]
    assert done.result.summary["poses"] == "sfm" and all(frame.registered for frame in frames)
    assert errors_of_poses(done.out)[1] < 0.05  # the arc is 2.4 long
    assert same_bytes(done.out, placed.out), "on one thread"


def test_sequential_matching_is_reproducible(images: Path, ingest: Ingest) -> None:
    settings = {"exhaustive_below": 0, "overlap": 2, "loop_candidates": 2}
    one, two = (
        ingest(images, f"t{threads}", threads=threads, kept=f"k{threads}", **settings) for threads in (1, 2)
    )
    assert one.result.summary["registered"] == 10
    assert same_bytes(one.out, two.out)


def test_poses_can_be_ignored(posed: Path, ingest: Ingest) -> None:
    (posed / "transforms.json").write_text(
        json.dumps({"frames": [{"file_path": f"images/{i:03d}"} for i in range(10)]})
    )
    assert ingest(posed, poses="sfm").result.summary["poses"] == "sfm"
    with pytest.raises(InputError, match="fl_x"):
        ingest(posed, "auto")


def test_own_result_is_a_colmap_project(first: Path, ingest: Ingest) -> None:
    (first / "images" / "999.png").write_bytes((first / "images" / "000003.png").read_bytes())
    second = ingest(first, "second")
    frames = load_frames(second.out)
    assert second.result.summary["kind"] == "colmap"
    # An image that the model does not know stays in the table, unregistered, with the shared camera.
    assert [frame.registered for frame in frames] == [True] * 10 + [False]
    assert [frame.placed for frame in frames] == ["given"] * 10 + ["no pose in the input"]
    assert frames[-1].qw is None and frames[-1].n_points == 0 and frames[-1].fx == frames[0].fx
    one, two = load_points(first), load_points(second.out)
    assert np.array_equal(one.point_id, two.point_id) and np.allclose(one.xyz, two.xyz, atol=1e-9)
    assert np.array_equal(one.rgb, two.rgb)


def test_resize_keeps_the_rays(posed: Path, ingest: Ingest) -> None:
    frame = load_frames(ingest(posed, max_size=160, feature_size=320).out)[0]
    assert (frame.width, frame.height) == (160, 120)
    assert np.allclose(
        [frame.fx, frame.fy, frame.cx, frame.cy], [FOCAL / 2, FOCAL / 2, WIDTH / 4, HEIGHT / 4]
    )


def test_test_frames_give_no_colour(posed: Path, ingest: Ingest) -> None:
    held = ingest(posed, "held", holdout="004")
    frames = load_frames(held.out)
    assert [frame.split for frame in frames] == ["train"] * 4 + ["test"] + ["train"] * 5
    assert frames[4].registered and frames[4].n_points > 0
    # The colour of a point is the mean over its train frames, recomputed here from the published images.
    model = read_model(held.out / "colmap" / "sparse" / "0")
    points = load_points(held.out)
    sums, counts = np.zeros((len(points.xyz), 3)), np.zeros(len(points.xyz))
    for frame in frames:
        if frame.split == "train":
            image = model.images[frame.frame_id + 1]
            rows = np.searchsorted(points.point_id, image.point_ids)
            x, y = image.xy.astype(int).T
            sums[rows] += cv2.imread(str(held.out / frame.image))[..., ::-1][y, x]
            counts[rows] += 1
    assert counts.min() >= 1
    assert np.array_equal(points.rgb, np.rint(sums / counts[:, None]).astype(np.uint8))


@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
def test_transparency_is_a_mask(posed: Path, ingest: Ingest, depth: type[np.unsignedinteger]) -> None:
    for index in range(3):
        path = posed / "images" / f"{index:03d}.png"
        picture = cv2.imread(str(path)).astype(depth) * (1 if depth is np.uint8 else 257)
        most = np.iinfo(depth).max
        alpha = np.full((HEIGHT, WIDTH, 1), most if index == 2 else 0, depth)
        alpha[:, WIDTH // 2 :] = most
        cv2.imwrite(str(path), np.concatenate([picture, alpha], axis=2))
    done = ingest(posed, depth.__name__)
    frames = load_frames(done.out)
    assert [frame.mask is not None for frame in frames] == [True, True] + [False] * 8, "2 is opaque all over"
    published = cv2.imread(str(done.out / str(frames[0].mask)), cv2.IMREAD_UNCHANGED)
    assert (published[:, : WIDTH // 2] == 0).all() and (published[:, WIDTH // 2 :] == 255).all()
    assert any(line.startswith("2 of 10 images are transparent") for line in done.infos)


def test_images_of_one_size_share_a_camera(images: Path, ingest: Ingest) -> None:
    """A folder of two sizes was refused; with a camera a frame only a few could be placed."""
    for index in range(0, 10, 2):
        path = images / f"view{index}.png"
        small = cv2.resize(
            cv2.imread(str(path)), (3 * WIDTH // 4, 3 * HEIGHT // 4), interpolation=cv2.INTER_AREA
        )
        cv2.imwrite(str(path), small)
    done = ingest(images, camera_model="SIMPLE_PINHOLE")
    frames = load_frames(done.out)
    assert done.result.summary["registered"] == 10
    assert {(frame.width, frame.height, frame.fx) for frame in frames[::2]} == {
        (frames[0].width, frames[0].height, frames[0].fx)
    }
    assert len({frame.fx for frame in frames}) == 2
    # The same lens: their focal lengths are as their sizes, as nearly as ten small images tell (3 %).
    assert frames[0].fx / frames[1].fx == pytest.approx(0.75, rel=0.03)


def test_masks_follow_their_images(posed: Path, ingest: Ingest) -> None:
    (posed / "masks").mkdir()
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, : WIDTH // 2] = 0
    for index in range(10):
        cv2.imwrite(str(posed / "masks" / f"{index:03d}.png"), mask)
    done = ingest(posed, max_size=160, feature_size=320)
    frames = load_frames(done.out)
    published = cv2.imread(str(done.out / str(frames[0].mask)), cv2.IMREAD_UNCHANGED)
    assert published.shape == (120, 160) and set(np.unique(published)) == {0, 255}
    assert (published[:, :80] == 0).all() and (published[:, 80:] == 255).all()
    model = read_model(done.out / "colmap" / "sparse" / "0")
    assert min(image.xy[:, 0].min() for image in model.images.values()) >= 79


def test_a_killed_run_goes_on_to_the_same_result(
    images: Path, placed: Ingested, ingest: Ingest, tmp_path: Path
) -> None:
    ingest(images, "resumed")
    # As if killed after matching and half of the publishing.
    work, out = tmp_path / "resumed.work", tmp_path / "resumed"
    for leftover in [*(work / "model").iterdir(), out / "points.parquet", *sorted(out.glob("images/*"))[5:]]:
        leftover.unlink()
    (work / "model").rename(work / "model.partial")
    (work / "images" / "000003.png").unlink()
    assert same_bytes(placed.out, ingest(images, "resumed").out)


def test_few_registered_frames_fail_or_warn(images: Path, ingest: Ingest) -> None:
    for index in range(10, 18):
        flat = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
        cv2.imwrite(str(images / f"view{index}.png"), flat)
    done = ingest(images, min_registered=0.5)
    assert [frame.registered for frame in load_frames(done.out)] == [True] * 10 + [False] * 8
    assert [frame.placed for frame in load_frames(done.out)] == ["sfm"] * 10 + ["no features"] * 8
    few, unplaced = done.warnings
    assert "only 18 frames" in few and "10 of 18" in unplaced
    (images.parent / "strict.work").symlink_to(images.parent / "out.work")  # the same work, checked again
    with pytest.raises(StageError, match="only 10 of 18") as caught:
        ingest(images, "strict", min_registered=0.9)
    assert "ingest.camera_model" in caught.value.hint


def test_textureless_frames(tmp_path: Path, ingest: Ingest) -> None:
    folder = tmp_path / "grey"
    folder.mkdir()
    for index in range(5):
        cv2.imwrite(str(folder / f"{index}.png"), np.full((HEIGHT, WIDTH, 3), 100 + index, np.uint8))
    with pytest.raises(StageError, match="no features were found in any frame"):
        ingest(folder)


def test_blurred_frames_are_placed_at_half_resolution(images: Path, ingest: Ingest) -> None:
    for index in (4, 7):
        path = images / f"view{index}.png"
        cv2.imwrite(str(path), cv2.blur(cv2.imread(str(path)), (25, 1)))
    done = ingest(images)
    words = [frame.placed for frame in load_frames(done.out)]
    second = "sfm at half resolution"
    assert words == [second if index in (4, 7) else "sfm" for index in range(10)]
    assert done.result.summary["placed"] == {"sfm": 8, "sfm at half resolution": 2}
    # The arc is 2.4 long. The blur covers 25 px, 0.3 at the depth of the planes; what is left of it is 0.06.
    assert errors_of_poses(done.out)[1] < 0.1
    assert same_bytes(done.out, ingest(images, "again", threads=2, kept="other").out)


def test_dark_frames_get_fainter_features(images: Path, ingest: Ingest) -> None:
    """At a tenth of the contrast, COLMAP's features are too few to start with."""
    for path in images.iterdir():
        cv2.imwrite(str(path), np.rint(40 + 0.1 * (cv2.imread(str(path)) - 40.0)))
    done = ingest(images)
    assert done.result.summary["placed"] == {"sfm": 10}
    # The arc is 2.4 long. Rounding to 25 levels leaves 0.02.
    assert errors_of_poses(done.out)[1] < 0.1


OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.mark.parametrize(
    ("meant", "words"),
    [
        (lambda pose: pose, "matrices with OpenCV axes"),
        (lambda pose: np.linalg.inv(pose @ OPENGL), "from the world to the camera"),
        (lambda pose: np.linalg.inv(pose), "from the world to the camera, with OpenCV axes"),
    ],
)
def test_matrices_of_another_convention(posed: Path, ingest: Ingest, meant: object, words: str) -> None:
    assert callable(meant)
    # `write_transforms` changes the axes of each matrix to OpenGL's.
    write_transforms(posed, [meant(pose) @ OPENGL for pose in camera_to_world(10)])
    done = ingest(posed)
    assert done.result.summary["poses"] == "given" and words in done.result.summary["pose_convention"]
    assert any(words in text for text in done.warnings)
    assert errors_of_poses(done.out) < (1e-4, 1e-6)
    centres = np.stack([pose_of(frame).centre for frame in load_frames(done.out)])
    truth = np.stack([pose[:3, 3] for pose in camera_to_world(10)])
    assert np.allclose(back_to_input(done.out, centres), truth, atol=1e-9)


@pytest.mark.parametrize("focal", [250.0, 360.0])
def test_a_wrong_focal_length_is_adjusted(posed: Path, ingest: Ingest, focal: float) -> None:
    write_transforms(posed, camera_to_world(10), fl_x=focal, fl_y=focal)
    done = ingest(posed, refine_above=0.3)  # px, in images 320 px wide
    assert done.result.summary["poses"] in ("adjusted", "sfm")
    assert all(abs(frame.fx / FOCAL - 1) < 0.02 for frame in load_frames(done.out))
    assert errors_of_poses(done.out) < (0.3, 0.05)


def test_the_lens_follows_from_the_images(images: Path, placed: Ingested, ingest: Ingest) -> None:
    """A sum of radial terms that one term does not fit, and none."""
    assert placed.result.summary["cameras"][0]["lens"] == "SIMPLE_RADIAL"
    lens = Intrinsics(
        "OPENCV", WIDTH, HEIGHT, (FOCAL, 1.04 * FOCAL, WIDTH / 2, HEIGHT / 2, -0.25, 0.3, 0.004, -0.003)
    )
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    rays = lens.colmap().cam_from_img(np.stack([columns, rows], axis=-1).reshape(-1, 2))
    where = (rays * FOCAL + (WIDTH / 2, HEIGHT / 2) - 0.5).astype(np.float32).reshape(HEIGHT, WIDTH, 2)
    for path in images.iterdir():
        bent = cv2.remap(cv2.imread(str(path)), where[..., 0], where[..., 1], cv2.INTER_CUBIC)
        cv2.imwrite(str(path), bent)
    bent = ingest(images, "bent")
    assert bent.result.summary["cameras"][0]["lens"] == "OPENCV"
    assert errors_of_poses(bent.out)[1] < 0.05
