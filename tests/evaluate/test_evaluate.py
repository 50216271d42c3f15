"""Evaluation of a small scene against its own renders: worlds, poses, hold-out, adjustments, results."""

from __future__ import annotations

import importlib.metadata
import json
import math
from dataclasses import replace
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from eval_world import (
    FOCAL,
    HEIGHT,
    PLAIN,
    WIDTH,
    WORLD,
    Remarks,
    cameras,
    make_scene,
    picture,
    turned,
    write_reference,
    write_run,
)
from numpy.typing import NDArray
from OpenImageIO import ImageOutput, ImageSpec
from scipy.spatial.transform import Rotation

from cleargs import plugins
from cleargs.capture.cameras import Intrinsics as Lens
from cleargs.capture.cameras import Pose, Similarity
from cleargs.errors import InputError
from cleargs.evaluate import refinement
from cleargs.evaluate.alignment import align_cameras, umeyama
from cleargs.evaluate.config import EvalOptions
from cleargs.evaluate.eval_report import Evaluation, Report, read_report, split_hash, write_report
from cleargs.evaluate.evaluate import evaluate_images, evaluate_scene
from cleargs.evaluate.metrics import apply_affine, fit_affine
from cleargs.evaluate.predictions import exposure_of
from cleargs.evaluate.references import Reference, reference_of
from cleargs.formation.measured import MeasuredPath
from cleargs.formation.motion import readout_of
from cleargs.media.exr import write_depth
from cleargs.media.image import read_rgb, to_uint8, write_mask, write_rgb
from cleargs.progress import reporter_of
from cleargs.splat.backend import rasteriser_for
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.render import render
from cleargs.splat.scene import Scene

SAME = Similarity(np.eye(3), np.zeros(3), 1.0)

# Poses pass through another world and back in float64; a float32 render then differs in few pixels by one
# step of 255 (60 dB and more), where a pose 0.1 degrees wrong gives less than 45 dB.
NEARLY_EQUAL = 58.0


def measured(scene: Path, reference: Reference, options: EvalOptions = PLAIN, threads: int = 1) -> Evaluation:
    return evaluate_scene(scene, reference, options=options, threads=threads, reporter=Remarks())


def in_own_world(folder: Path) -> Reference:
    return reference_of(None, folder, reporter=Remarks())


def psnr_of(evaluation: Evaluation) -> float:
    found = evaluation.means["psnr"]
    assert found is not None
    return found


# -- worlds and poses --------------------------------------------------------------------------------------


def test_umeyama_recovers_a_planted_similarity() -> None:
    rng = np.random.default_rng(3)
    source = rng.normal(size=(12, 3)) + 1e5  # far from the origin, as GPS-based worlds are
    fit = umeyama(source, WORLD.points(source))
    np.testing.assert_allclose(fit.rotation, WORLD.rotation, atol=1e-9)
    assert fit.scale == pytest.approx(WORLD.scale, rel=1e-9)
    np.testing.assert_allclose(fit.points(source), WORLD.points(source), atol=1e-9)
    target = WORLD.points(source) + rng.normal(0, 0.05, source.shape)
    errors = umeyama(source, target).points(source) - target
    assert 0.02 < np.sqrt((errors**2).mean()) < 0.05  # less than the noise: it is fitted, too


def test_umeyama_does_not_mirror() -> None:
    source = np.random.default_rng(0).normal(size=(8, 3))
    fit = umeyama(source, source * [1, 1, -1])
    assert np.linalg.det(fit.rotation) == pytest.approx(1.0)
    assert np.abs(fit.points(source) - source * [1, 1, -1]).max() > 0.1


@pytest.mark.parametrize("centres", [np.eye(3)[:2], np.outer(np.arange(5.0), [1, 2, 3])])
def test_umeyama_needs_three_places_off_a_line(centres: NDArray[np.float64]) -> None:
    with pytest.raises(InputError):
        umeyama(centres, centres)


def test_cameras_are_aligned_by_direction_too() -> None:
    """A walk straight ahead: its centres leave the turn about it open."""
    rng = np.random.default_rng(1)
    centres = np.outer(np.linspace(-1, 1, 16), [1.0, 0.2, 0.1]) + rng.normal(0, 0.01, (16, 3))
    turns = Rotation.from_rotvec(rng.normal(0, 0.3, (16, 3))).as_matrix()
    source = [Pose(turn, -turn @ centre) for turn, centre in zip(turns, centres, strict=True)]
    exact = [WORLD.pose(pose) for pose in source]
    fit, alignment = align_cameras(source, exact)
    np.testing.assert_allclose(fit.rotation, WORLD.rotation, atol=1e-9)
    assert fit.scale == pytest.approx(WORLD.scale, rel=1e-9)
    assert alignment.residual is not None and alignment.residual < 1e-9

    def shaken(pose: Pose) -> Pose:
        """A twentieth of a degree and a thousandth of the walk off, as SfM leaves a pose."""
        turn = Rotation.from_rotvec(rng.normal(0, 5e-4, 3)).as_matrix() @ pose.rotation
        return Pose(turn, -turn @ (pose.centre + rng.normal(0, 2e-3 / WORLD.scale, 3)))

    found = [shaken(pose) for pose in exact]
    centres_only = umeyama(centres, np.stack([pose.centre for pose in found]))
    off = [
        np.degrees(Rotation.from_matrix(similarity.rotation @ WORLD.rotation.T).magnitude())
        for similarity in (align_cameras(source, found)[0], centres_only)
    ]
    # Sixteen cameras average their errors to a quarter of a twentieth; the centres give degrees.
    assert off[0] < 0.06 and off[1] > 0.5


def test_own_renders_are_perfect_in_the_scenes_world(tmp_path: Path) -> None:
    scene = make_scene()
    run = write_run(tmp_path / "run", scene, cameras())
    folder = write_reference(tmp_path / "truth", scene, cameras(), similarity=SAME)
    found = measured(run / "g0" / "scene.ply", in_own_world(folder))
    assert psnr_of(found) > NEARLY_EQUAL and found.alignment.world == "scene"
    assert found.images[0].prediction and found.scene is not None


def test_a_frame_is_also_compared_as_its_camera_took_it(tmp_path: Path) -> None:
    """The camera turned by 4 px while it read the frames: only the render with that motion is like them."""
    scene = make_scene()
    run = write_run(tmp_path / "run", scene, cameras())
    folder = write_reference(tmp_path / "truth", scene, cameras(), similarity=SAME)
    derivatives = np.zeros((4, 6))
    derivatives[0, 4] = 4.0 / FOCAL / 0.02
    path = MeasuredPath(derivatives, np.eye(6), frame_s=1 / 30, depth=1.0, readout_s=0.02)
    still = in_own_world(folder)
    views = []
    for view in still.views:
        camera = replace(view.camera, readout=readout_of(path.read(view.camera), view.camera))
        filmed = to_uint8(rasteriser_for("cpu").view(scene, camera).image.clamp(0.0, 1.0).numpy())
        views.append(replace(view, path=path, load=lambda filmed=filmed: (filmed, None)))
    found = measured(run / "g0" / "scene.ply", replace(still, views=tuple(views)))
    formed = found.formed["psnr"]
    assert formed is not None and formed > psnr_of(found) + 15.0
    write_report(tmp_path / "eval.json", Report(evaluations=(found,)))
    rows = pq.read_table(tmp_path / "eval.parquet").to_pylist()
    assert [row["formed_ssim"] for row in rows] == [image.formed["ssim"] for image in found.images]
    assert measured(run / "g0" / "scene.ply", still).formed == {}
    # A turn of the poses by half a pixel: each render is fitted with its own pose.
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.0, 0.5 / FOCAL, 0.0]).as_matrix()
    turned = [
        replace(view, camera=replace(view.camera, world_to_camera=turn @ view.camera.world_to_camera))
        for view in views
    ]
    off, refined = (
        measured(
            run / "g0" / "scene.ply", replace(still, views=tuple(turned)), PLAIN.model_copy(update=options)
        )
        for options in ({}, {"refine_poses": 10})
    )
    before, after = off.formed["psnr"], refined.formed["psnr"]
    assert before is not None and after is not None and after > before + 15.0  # observed: 71 dB after


def test_the_exposure_time_is_that_of_several_frames(tmp_path: Path) -> None:
    def found(*times: float) -> float:
        rows = {"frame_id": list(range(9)), "exposure_s": [*times, *[0.0] * (9 - len(times))]}
        pq.write_table(pa.table(rows), tmp_path / "formation.parquet")
        return exposure_of(tmp_path)

    assert found() == found(0.1) == found(0.1, 0.1) == 0.0
    assert found(0.01, 0.03, 0.02) == 0.02


def test_a_library_without_a_distribution_is_absent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Conda's OpenCV, for example, is not a distribution of that name."""

    def version(name: str) -> str:
        if name == "opencv-contrib-python-headless":
            raise PackageNotFoundError(name)
        return importlib.metadata.version(name)

    monkeypatch.setattr(plugins, "version", version)
    scene = make_scene()
    run = write_run(tmp_path / "run", scene, cameras())
    folder = write_reference(tmp_path / "truth", scene, cameras(), similarity=SAME)
    versions = measured(run / "g0" / "scene.ply", in_own_world(folder)).versions
    assert versions["opencv-contrib-python-headless"] == "absent" != versions["torch"]


def test_poses_go_through_ingests_similarity(tmp_path: Path) -> None:
    scene = make_scene()
    run = write_run(tmp_path / "run", scene, cameras())
    folder = write_reference(tmp_path / "truth", scene, cameras())
    reference = reference_of(run, folder, reporter=Remarks())
    assert reference.alignment.world == "ingest" and reference.alignment.matched == 6
    assert psnr_of(measured(run / "g0" / "scene.ply", reference)) > NEARLY_EQUAL
    # Taken as they are, the poses are wrong.
    assert psnr_of(measured(run / "g0" / "scene.ply", in_own_world(folder))) < 25


def test_worlds_of_sfm_are_aligned_by_cameras(tmp_path: Path) -> None:
    scene, other = make_scene(), Similarity(WORLD.rotation.T, np.array([1.0, 2, 3]), 0.2)
    run = write_run(tmp_path / "run", scene, cameras(), poses="sfm")
    folder = write_reference(tmp_path / "truth", scene, cameras(), similarity=other)
    remarks = Remarks()
    reference = reference_of(run, folder, reporter=remarks)
    assert reference.alignment.world == "umeyama" and not remarks.warnings
    assert reference.alignment.residual is not None and reference.alignment.residual < 1e-9
    assert psnr_of(measured(run / "g0" / "scene.ply", reference)) > NEARLY_EQUAL


def test_equal_stems_of_other_views_are_noticed_and_helped(tmp_path: Path) -> None:
    scene, novel = make_scene(), [turned(camera, 3.0) for camera in cameras()[::-1]]
    run = write_run(tmp_path / "run", scene, cameras(), poses="sfm")
    observed = write_reference(tmp_path / "frames", scene, cameras())
    folder = write_reference(tmp_path / "novel", scene, novel)
    with pytest.raises(InputError, match="too large") as caught:
        reference_of(run, folder, reporter=Remarks())
    assert "--align" in str(caught.value.hint)
    reference = reference_of(run, folder, align=observed, reporter=Remarks())
    assert psnr_of(measured(run / "g0" / "scene.ply", reference)) > NEARLY_EQUAL


def test_given_poses_are_the_runs_own(tmp_path: Path) -> None:
    scene, noisy = make_scene(), [turned(camera, 1.0) for camera in cameras()]
    run = write_run(tmp_path / "run", scene, noisy)
    folder = write_reference(tmp_path / "truth", scene, cameras())
    at_truth = measured(run / "g0" / "scene.ply", reference_of(run, folder, reporter=Remarks()))
    given = reference_of(run, folder, poses="given", reporter=Remarks())
    at_given = measured(run / "g0" / "scene.ply", given)
    assert psnr_of(at_truth) > NEARLY_EQUAL and psnr_of(at_given) < 35
    assert at_given.poses == "given" and at_given.split == at_truth.split


def test_reference_at_another_size(tmp_path: Path) -> None:
    scene, large = make_scene(), [camera.resized(144, 108) for camera in cameras()]
    run = write_run(tmp_path / "run", scene, cameras())
    folder = write_reference(tmp_path / "truth", scene, large)
    for poses in ("reference", "given"):
        found = measured(run / "g0" / "scene.ply", reference_of(run, folder, poses=poses, reporter=Remarks()))
        assert found.images[0].width == 144 and psnr_of(found) > NEARLY_EQUAL


def test_distorted_references_are_undistorted(tmp_path: Path) -> None:
    scene = make_scene()
    lens = Lens("OPENCV", WIDTH, HEIGHT, (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, 0.08, 0.0, 0.0, 0.0))
    pixels = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), -1).reshape(-1, 2)
    rays = np.asarray(lens.colmap().cam_from_img(pixels)).reshape(HEIGHT, WIDTH, 2)
    wide, zoom = cameras(), 4  # a finer render to sample from
    pictures = []
    for camera in wide:
        fine = picture(scene, camera.resized(zoom * WIDTH, zoom * HEIGHT))
        at = (rays * FOCAL + [WIDTH / 2, HEIGHT / 2]) * zoom - 0.5
        maps = at[..., 0].astype(np.float32), at[..., 1].astype(np.float32)
        pictures.append(np.asarray(cv2.remap(fine, *maps, cv2.INTER_AREA, borderMode=cv2.BORDER_REFLECT)))
    run = write_run(tmp_path / "run", scene, wide)
    folder = write_reference(tmp_path / "truth", scene, wide, lens={"k1": 0.08}, pictures=pictures)
    found = measured(run / "g0" / "scene.ply", reference_of(run, folder, reporter=Remarks()))
    assert found.images[0].width < WIDTH  # the corners of the lens's image are cropped
    ignored = write_reference(tmp_path / "wrong", scene, wide, pictures=pictures)
    without = measured(run / "g0" / "scene.ply", reference_of(run, ignored, reporter=Remarks()))
    # Resampling twice costs sharpness (about 33 dB); distortion left alone costs far more.
    assert psnr_of(found) > psnr_of(without) + 5


# -- compared pixels ---------------------------------------------------------------------------------------


def test_held_out_frames_with_their_masks(tmp_path: Path) -> None:
    scene = make_scene()
    run = write_run(tmp_path / "run", scene, cameras(), test=[1, 4], masked=True)
    image = run / "ingest" / "images" / "000001.png"
    damaged = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    damaged[:, WIDTH // 2 :] = picture(scene, cameras()[1])[:, WIDTH // 2 :]
    write_rgb(image, damaged)  # wrong only where the mask says ignore
    reference = reference_of(run, None, reporter=Remarks())
    found = measured(run / "g0" / "scene.ply", reference)
    assert found.reference == "holdout" and [image.name for image in found.images] == ["001", "004"]
    assert psnr_of(found) > NEARLY_EQUAL


def test_a_mask_beside_the_references(tmp_path: Path) -> None:
    scene = make_scene()
    run = write_run(tmp_path / "run", scene, cameras())
    pictures = [picture(scene, camera) for camera in cameras()]
    pictures[2] = pictures[2].copy()
    pictures[2][:20, :30] = 0
    folder = write_reference(tmp_path / "truth", scene, cameras(), pictures=pictures)
    before = measured(run / "g0" / "scene.ply", reference_of(run, folder, reporter=Remarks()))
    (folder / "masks").mkdir()
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:20, :30] = 0
    write_mask(folder / "masks" / "002.png", mask)
    after = measured(run / "g0" / "scene.ply", reference_of(run, folder, reporter=Remarks()))
    assert (before.images[2].values["psnr"] or 0) < 30
    assert psnr_of(after) > NEARLY_EQUAL and after.split != before.split


def test_a_half_turn_of_exif_is_taken_as_ingest_does(tmp_path: Path) -> None:
    """Half a turn keeps the proportions, so the camera is that of the image as it is stored."""
    scene = make_scene()
    run = write_run(tmp_path / "run", scene, cameras())
    folder = write_reference(tmp_path / "truth", scene, cameras())
    spec = ImageSpec(WIDTH, HEIGHT, 3, "uint8")
    spec.attribute("Orientation", 3)
    output = ImageOutput.create("turned.png")
    assert output.open(str(folder / "images" / "002.png"), spec)
    assert output.write_image(picture(scene, cameras()[2]))
    output.close()
    assert psnr_of(measured(run / "g0" / "scene.ply", reference_of(run, folder, reporter=Remarks()))) > (
        NEARLY_EQUAL
    )


def test_another_methods_images(tmp_path: Path) -> None:
    scene = make_scene()
    folder = write_reference(tmp_path / "truth", scene, cameras(), similarity=SAME)
    (tmp_path / "theirs").mkdir()
    for index in (0, 2, 3):
        write_rgb(tmp_path / "theirs" / f"{index:03d}.png", picture(scene, cameras()[index]))
    remarks = Remarks()
    found = evaluate_images(
        tmp_path / "theirs", in_own_world(folder), options=PLAIN, threads=1, reporter=remarks
    )
    assert psnr_of(found) == math.inf and found.scene is None and found.subject == "theirs"
    assert "3 of 6" in remarks.warnings[0]


def test_saved_renders_evaluate_to_the_same(tmp_path: Path) -> None:
    scene = make_scene()
    run = write_run(tmp_path / "run", scene, [turned(camera, 1.0) for camera in cameras()])
    folder = write_reference(tmp_path / "truth", scene, cameras())
    reference = reference_of(run, folder, poses="given", reporter=Remarks())
    options = PLAIN.model_copy(update={"align_colour": True})
    saved = evaluate_scene(
        run / "g0" / "scene.ply",
        reference,
        options=options,
        threads=1,
        reporter=Remarks(),
        save=tmp_path / "saved",
    )
    lines = list[str]()
    told = reporter_of(lines.append)
    again = evaluate_images(tmp_path / "saved", reference, options=PLAIN, threads=1, reporter=told)
    assert lines[0] == "loading the metrics: started", "for ten seconds on a busy machine there was no line"
    assert again.means == saved.means and again.split == saved.split
    assert [i.prediction for i in again.images] == [i.prediction for i in saved.images]


def test_results_do_not_depend_on_threads(tmp_path: Path) -> None:
    scene = make_scene()
    run = write_run(tmp_path / "run", scene, [turned(camera, 0.4) for camera in cameras()])
    folder = write_reference(tmp_path / "truth", scene, cameras())
    reference = reference_of(run, folder, poses="given", reporter=Remarks())
    options = EvalOptions(scorers=("naturalness-stats",), lpips=(), align_colour=True, refine_poses=2)
    one, two = (measured(run / "g0" / "scene.ply", reference, options, threads) for threads in (1, 2))
    assert one.model_dump_json() == two.model_dump_json()


# -- adjustments -------------------------------------------------------------------------------------------


def test_colour_alignment_recovers_a_planted_affine(tmp_path: Path) -> None:
    planted = np.array([[0.8, 0.05, 0, 0.05], [0, 0.7, 0.1, 0.1], [0.05, 0, 0.75, 0.08]])
    scene = make_scene()
    pictures = [
        (apply_affine(picture(scene, camera) / 255.0, planted) * 255).round().astype(np.uint8)
        for camera in cameras()
    ]
    folder = write_reference(tmp_path / "truth", scene, cameras(), similarity=SAME, pictures=pictures)
    run = write_run(tmp_path / "run", scene, cameras())
    plain = measured(run / "g0" / "scene.ply", in_own_world(folder))
    assert plain.images[0].colour is None and psnr_of(plain) < 30
    options = PLAIN.model_copy(update={"align_colour": True})
    aligned = measured(run / "g0" / "scene.ply", in_own_world(folder), options)
    # Both images are rounded to 8 bits.
    np.testing.assert_allclose(aligned.images[0].colour, planted, atol=2e-3)
    assert psnr_of(aligned) > 50


def test_colour_of_a_grey_image_stays_defined() -> None:
    grey = np.full((8, 8, 3), 0.5)
    affine = fit_affine(grey, grey * 0.5, None)
    np.testing.assert_allclose(apply_affine(grey, affine), grey * 0.5, atol=1e-4)
    np.testing.assert_array_equal(fit_affine(grey, grey, np.zeros((8, 8), bool)), np.eye(3, 4))


def test_pose_refinement_recovers_a_planted_turn(tmp_path: Path) -> None:
    scene = make_scene()
    run = write_run(tmp_path / "run", scene, [turned(camera, 1.0) for camera in cameras(3)])
    folder = write_reference(tmp_path / "truth", scene, cameras(3))
    reference = reference_of(run, folder, poses="given", reporter=Remarks())
    plain = measured(run / "g0" / "scene.ply", reference)
    options = PLAIN.model_copy(update={"refine_poses": 8})
    refined = measured(run / "g0" / "scene.ply", reference, options)
    assert psnr_of(plain) < 35 and plain.images[0].refinement is None
    for image in refined.images:
        assert image.refinement is not None
        assert image.refinement.rotation_deg == pytest.approx(1.0, abs=0.05)
        assert image.refinement.loss_after < 1e-2 * image.refinement.loss_before
    assert psnr_of(refined) > 45


def test_refined_poses_are_kept_only_where_they_are_better(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Behind the blur of the reduced image any pose may look better."""
    scene = make_scene()
    run = write_run(tmp_path / "run", scene, cameras(3))
    folder = write_reference(tmp_path / "truth", scene, cameras(3))
    reference = reference_of(run, folder, poses="given", reporter=Remarks())
    monkeypatch.setattr(
        refinement, "_descend", lambda comparison, pose, *_: turned(pose, 2.0) if comparison._blur else pose
    )
    plain = measured(run / "g0" / "scene.ply", reference)
    options = PLAIN.model_copy(update={"refine_poses": 8})
    refined = measured(run / "g0" / "scene.ply", reference, options)
    for image in refined.images:
        assert image.refinement is not None and image.refinement.rotation_deg == 0
        assert image.refinement.loss_after == image.refinement.loss_before
    assert psnr_of(refined) == psnr_of(plain)


@pytest.mark.parametrize("opaque", [True, False])
def test_a_scene_is_measured_over_white_too(tmp_path: Path, opaque: bool) -> None:
    """Transparent parts show the background of a viewer; opaque ones look the same over any."""
    scene = replace(make_scene(count=3000 if opaque else 100), background=(0.0, 0.0, 0.0))
    run = write_run(tmp_path / "run", scene, cameras())
    folder = write_reference(tmp_path / "truth", scene, cameras(), similarity=SAME)
    found = measured(run / "g0" / "scene.ply", in_own_world(folder))
    for image, camera in zip(found.images, cameras(), strict=True):
        black, white = (
            render(scene.gaussians, camera, background=(shade,) * 3).image.double().clamp(0.0, 1.0)
            for shade in (0.0, 1.0)
        )
        between = -10 * math.log10(float((black - white).square().mean()))
        assert image.psnr_between == pytest.approx(between, abs=0.1)
        # The references are renders over black, in steps of 1/255 (59 dB).
        assert image.psnr_white is not None
        assert image.psnr_white > 55 if opaque else image.psnr_white == pytest.approx(between, abs=0.5)
    assert found.psnr_between is not None and (found.psnr_between > 45) == opaque


def test_gaussians_in_front_of_the_true_surface_cover_a_share_of_the_view(tmp_path: Path) -> None:
    """A wall 4 units away, and a haze that hides about half of its middle."""
    side = 40
    x, y = np.meshgrid(np.linspace(-6, 6, side), np.linspace(-5, 5, side))
    wall = np.stack([x.ravel(), y.ravel(), np.full(side * side, 4.0)], axis=1)
    haze = np.array([[0.0, 0.0, 2.0]])

    def scene(*parts: NDArray[np.float64]) -> Scene:
        means = np.concatenate(parts)
        count = len(means)
        radii = np.where(means[:, 2] > 3.0, 0.25, 0.3)
        opacities = np.where(means[:, 2] > 3.0, 4.0, 0.0)
        arrays = (
            means,
            np.log(radii)[:, None].repeat(3, axis=1),
            np.tile([1.0, 0, 0, 0], (count, 1)),
            opacities,
            np.zeros((count, 1, 3)),
        )
        return Scene(Gaussians(*(torch.tensor(array, dtype=torch.float32) for array in arrays)))

    views = [cameras()[0]]
    folder = write_reference(tmp_path / "truth", scene(wall), views)
    (folder / "depth").mkdir()
    pose = views[0].world_to_camera
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([(columns - WIDTH / 2) / FOCAL, (rows - HEIGHT / 2) / FOCAL, np.ones_like(rows)], axis=-1)
    depth = (4.0 - views[0].centre[2]) / (rays @ pose[:3, :3])[..., 2]  # in the run's world
    write_depth(folder / "depth" / "000.exr", depth * WORLD.scale)
    shares = []
    for number, parts in enumerate(([wall], [wall, haze])):
        run = write_run(tmp_path / f"run{number}", scene(*parts), cameras())
        found = measured(run / "g0" / "scene.ply", reference_of(run, folder, reporter=Remarks()))
        assert found.covered == found.images[0].covered
        shares.append(found.covered)
    # Gaussian of 0.3 / 1.7 * 90 = 16 px and opacity 1/2: 0.5 * 2 pi * 16^2 px of 96 x 72.
    assert shares[0] == 0.0 and shares[1] == pytest.approx(0.115, abs=0.02)
    given = reference_of(run, folder, poses="given", reporter=Remarks())
    assert measured(run / "g0" / "scene.ply", given).covered is None  # another place, whose depth is unknown
    write_depth(folder / "depth" / "000.exr", depth[1:])
    with pytest.raises(InputError, match="96x71"):
        measured(run / "g0" / "scene.ply", reference_of(run, folder, reporter=Remarks()))


def test_psnr_with_aligned_colours_is_there_too(tmp_path: Path) -> None:
    scene = make_scene()
    run = write_run(tmp_path / "run", scene, cameras(3))
    folder = write_reference(tmp_path / "truth", scene, cameras(3))
    for path in (folder / "images").iterdir():
        write_rgb(path, (0.7 * read_rgb(path)).astype(np.uint8))
    found = measured(run / "g0" / "scene.ply", reference_of(run, folder, reporter=Remarks()))
    aligned = found.psnr_colour_aligned
    assert aligned is not None and aligned > psnr_of(found) + 10
    options = PLAIN.model_copy(update={"align_colour": True})
    again = measured(run / "g0" / "scene.ply", reference_of(run, folder, reporter=Remarks()), options)
    assert again.psnr_colour_aligned is None and psnr_of(again) == pytest.approx(aligned)


# -- the result --------------------------------------------------------------------------------------------


def test_the_result_is_written_and_read(tmp_path: Path) -> None:
    scene = make_scene()
    folder = write_reference(tmp_path / "truth", scene, cameras(), similarity=SAME)
    (tmp_path / "theirs").mkdir()
    for index, camera in enumerate(cameras()):
        write_rgb(tmp_path / "theirs" / f"{index:03d}.png", picture(scene, turned(camera, float(index))))
    options = PLAIN.model_copy(update={"align_colour": True})
    found = evaluate_images(
        tmp_path / "theirs", in_own_world(folder), options=options, threads=1, reporter=Remarks()
    )
    report = Report(evaluations=(found,))
    path = tmp_path / "deep" / "eval.json"
    write_report(path, report)
    json.loads(path.read_text(), parse_constant=pytest.fail)  # plain JSON, without Infinity or NaN
    assert read_report(path) == report
    rows = pq.read_table(path.with_suffix(".parquet")).to_pylist()
    assert [row["psnr"] for row in rows] == [image.values["psnr"] for image in found.images]
    assert len(rows[0]["colour"]) == 12
    assert found.means["ssim"] == pytest.approx(np.mean([row["ssim"] for row in rows]))
    assert found.split == split_hash({row["name"]: row["reference"] for row in rows})


def test_an_infinite_psnr_survives_the_file(tmp_path: Path) -> None:
    scene = make_scene()
    folder = write_reference(tmp_path / "truth", scene, cameras(2), similarity=SAME)
    found = evaluate_images(
        folder / "images", in_own_world(folder), options=PLAIN, threads=1, reporter=Remarks()
    )
    write_report(tmp_path / "eval.json", Report(evaluations=(found,)))
    json.loads((tmp_path / "eval.json").read_text(), parse_constant=pytest.fail)
    assert read_report(tmp_path / "eval.json").evaluations[0].means["psnr"] == math.inf


def test_held_out_frames_of_a_rig_share_names(tmp_path: Path) -> None:
    """Each camera of a rig has a folder, and frames of the same names."""
    run = write_run(tmp_path / "run", make_scene(), cameras(), test=[1, 4])
    table = pq.read_table(run / "ingest" / "frames.parquet")
    names = [f"cam{row % 2}/0001.jpg" for row in range(table.num_rows)]
    place = table.schema.get_field_index("name")
    table = table.set_column(place, table.schema.field(place), [names])
    pq.write_table(table, run / "ingest" / "frames.parquet")
    reference = reference_of(run, None, reporter=Remarks())
    found = measured(run / "g0" / "scene.ply", reference)
    assert [image.name for image in found.images] == ["000001-0001", "000004-0001"]
    assert psnr_of(found) > NEARLY_EQUAL


@pytest.mark.parametrize("kind", ["COLMAP's name", "transparency"])
def test_masks_of_references_are_those_of_ingest(tmp_path: Path, kind: str) -> None:
    """Pixels that training ignores do not lower the figures."""
    scene = make_scene()
    run = write_run(tmp_path / "run", scene, cameras())
    pictures = [picture(scene, camera) for camera in cameras()]
    counts = np.full((HEIGHT, WIDTH), 255, np.uint8)
    counts[:20, :30] = 0
    pictures[2] = pictures[2] * (counts > 0)[..., None]
    folder = write_reference(tmp_path / "truth", scene, cameras(), pictures=pictures)
    if kind == "transparency":
        clear = np.dstack([pictures[2][..., ::-1], counts])
        cv2.imwrite(str(folder / "images" / "002.png"), clear)
    else:
        (folder / "masks").mkdir()
        write_mask(folder / "masks" / "002.png.png", counts)
    found = measured(run / "g0" / "scene.ply", reference_of(run, folder, reporter=Remarks()))
    assert (found.images[2].values["psnr"] or 0) > NEARLY_EQUAL
