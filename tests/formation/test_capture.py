"""Formation inside a training: found, earned, resumed; and the bits of plain training where there is none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from cleargs.formation import capture, estimate
from cleargs.formation.capture import ESTIMATES_TO_KEEP, CaptureFormation
from cleargs.formation.comparison import MIN_RESIDUAL, FramePair, MotionFit
from cleargs.formation.exposure import Exposure
from cleargs.formation.formed import render_formed
from cleargs.formation.frame import FrameFormation
from cleargs.formation.motion import FrameMotion
from cleargs.formation.movement import CELLS, static_pixels
from cleargs.formation.pretest import MissingBlur
from cleargs.formation.search import search
from cleargs.formation.shutter import MIN_TESTED_FRAMES, CameraSpeeds
from cleargs.formation.table import read_formation, write_formation
from cleargs.progress import SilentReporter
from cleargs.splat.camera import Camera
from cleargs.splat.config import FormationConfig, TrainConfig
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.scene import Scene
from cleargs.splat.trainer import Trainer
from cleargs.splat.training import Trained
from cleargs.splat.training import run as run_training
from cleargs.splat.views import TrainingView

WIDTH, HEIGHT, FRAMES = 96, 64, 5
CONFIG = TrainConfig(
    steps=60,
    densify=False,
    coarse_share=0.0,
    sh_every=0.0,
    checkpoint_interval=17,
    # Training starts from the truth: what changes it is what the frames teach, not the first steps of Adam.
    lr_means=0.0,
    lr_scales=0.0,
    lr_rotations=0.0,
    lr_opacities=0.0,
    lr_sh=2e-3,
    opacity_reg=0.0,
    scale_reg=0.0,
    background=(0.0, 0.0, 0.0),  # the wall has gaps
)
LOOK = FormationConfig(start=0.0, every=4)
DRAFT = LOOK.model_copy(update={"first_search": False})
BLURRED = 2
BLUR = FrameMotion(blur=np.array([0, 0, 0, 0, 7.0, 0]), median_depth=3.0)
BENT = replace(BLUR, bend=np.array([0, 0, 0, 14.0, 0, 0]), pose=np.array([0, 0, 0, 14.0 / 12.0, 0, 0]))
"""An arc: the camera also nods by a quarter of the bend, 3.5 px, down and up again. The frame's pose is that
at the middle of the exposure."""


def camera(angle: float) -> Camera:
    pose = np.eye(4)
    pose[0, 0] = pose[2, 2] = np.cos(angle)
    pose[0, 2], pose[2, 0] = np.sin(angle), -np.sin(angle)
    return Camera(WIDTH, HEIGHT, 90.0, 90.0, WIDTH / 2, HEIGHT / 2, pose)


def scene() -> Scene:
    """A wall of coloured squares, small enough that a blur shows."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[-1.1:1.1:40j, -1.8:1.8:64j]
    count = x.size
    means = np.stack([x.ravel(), y.ravel(), np.full(count, 3.0)], 1)
    colours = cv2.resize(rng.uniform(-1.5, 1.5, (14, 22, 3)), (64, 40), interpolation=cv2.INTER_NEAREST)
    return Scene(
        Gaussians(
            means=torch.tensor(means, dtype=torch.float32),
            log_scales=torch.full((count, 3), -3.5),
            rotations=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
            logit_opacities=torch.full((count,), 4.0),
            sh=torch.tensor(colours.reshape(count, 1, 3), dtype=torch.float32),
        )
    )


def views(
    blurred: int | None = BLURRED, weights: list[float] | None = None, motion: FrameMotion = BLUR
) -> list[TrainingView]:
    made = []
    for index, angle in enumerate(np.linspace(-0.1, 0.1, FRAMES)):
        view = TrainingView(index, camera(angle), 1.0, "real", lambda: (None, None))
        moved = FrameFormation(index, motion, "blur", displacement_px=4.0) if index == blurred else None
        seen = render_formed(scene(), view, formation=moved).numpy()
        pixels = np.rint(255 * seen).astype(np.uint8)
        weight = 1.0 if weights is None else weights[index]
        made.append(TrainingView(index, view.camera, weight, "real", lambda pixels=pixels: (pixels, None)))
    return made


def run(folder: Path, seen: list[TrainingView], formation: CaptureFormation | None) -> Trained:
    folder.mkdir(exist_ok=True)
    trainer = Trainer(scene(), seen, CONFIG, seed=(3,), formation=formation)
    return run_training(trainer, checkpoint=folder / "state.safetensors", reporter=SilentReporter())


def test_a_blurred_frame_is_found_and_the_sharp_ones_are_left_alone(tmp_path: Path) -> None:
    formation = CaptureFormation(views(), LOOK)
    run(tmp_path, views(), formation)
    models = {frame_id: frame.model for frame_id, frame in formation.frames.items()}
    assert models == {k: "blur" if k == BLURRED else "none" for k in range(FRAMES)}
    found = formation.frames[BLURRED]
    assert found.blur_px == pytest.approx(7.0, abs=1.0)
    assert found.explained > 0.5
    assert found.motion.order == 1


def test_an_arc_is_found_and_kept_in_the_table(tmp_path: Path) -> None:
    seen = views(motion=BENT)
    formation = CaptureFormation(seen, LOOK)
    run(tmp_path, seen, formation)
    found = formation.frames[BLURRED]
    assert found.motion.order > 1 and found.explained > 0.6
    # An exposure is the same from its end to its start, but its bend is not turned by that.
    # In front of a wall a step down looks like a turn.
    assert found.motion.bend[3] - found.motion.bend[1] == pytest.approx(14.0, abs=3.0)
    assert abs(found.motion.blur[4]) == pytest.approx(7.0, abs=1.0)
    path = tmp_path / "formation.parquet"
    write_formation(path, formation, dict.fromkeys(range(FRAMES), 1.0))
    again = read_formation(path)[0][BLURRED]
    np.testing.assert_array_equal(again.motion.vector, found.motion.vector)
    table = pq.read_table(path)
    assert table.column("order").to_pylist()[BLURRED] == found.motion.order


def test_a_wrong_pose_is_corrected_where_it_is_an_estimate(tmp_path: Path) -> None:
    for estimated, setting, moved in (
        (True, "auto", 3.0),
        (False, "auto", 0.0),
        (False, "on", 3.0),
        (True, "off", 0.0),
    ):
        shifted = replace(BLUR, pose=np.array([0, 0, 0, 3.0, 0, 0]))
        seen = [replace(view, estimated=estimated) for view in views(motion=shifted)]
        formation = CaptureFormation(seen, LOOK.model_copy(update={"pose": setting}))
        run(tmp_path / f"{estimated}-{setting}", seen, formation)
        motion = formation.frames[BLURRED].motion
        pose = motion.pose - motion.bend / 12.0  # at the middle of the exposure
        # In front of a wall a step down looks like a turn.
        assert pose[3] - pose[1] == pytest.approx(moved, abs=0.3), (estimated, setting)
    assert FormationConfig(pose=False).pose == "off" and FormationConfig(pose=True).pose == "on"


def test_a_common_drift_does_not_carry_the_reliable_frames_away(tmp_path: Path) -> None:
    """Four of five poses are wrong by the same turn; the frame without a motion holds the scene in place."""
    drift = replace(BLUR, pose=np.array([0, 0, 0, 0, 2.0, 0]))
    seen = [
        replace(views(k, motion=drift)[k] if k != BLURRED else views(None)[k], estimated=True)
        for k in range(FRAMES)
    ]
    formation = CaptureFormation(seen, LOOK)
    trained = run(tmp_path, seen, formation)
    anchor = formation.frames[BLURRED]
    assert anchor.model == "none" and not anchor.motion.vector.any()
    corrections = [
        frame.motion.pose[4] + frame.motion.pose[0] for k, frame in formation.frames.items() if k != BLURRED
    ]
    assert corrections == pytest.approx([2.0] * (FRAMES - 1), abs=0.4)
    sharp = views(None)[BLURRED]
    error = render_formed(trained.scene, sharp) - torch.from_numpy(sharp.load()[0].astype(np.float32) / 255)
    assert float(error.square().mean()) < 1e-3


def test_with_it_a_blurred_frame_teaches_a_sharp_scene(tmp_path: Path) -> None:
    """Alone with a blurred frame the scene learns its blur, or what was in front of the camera."""
    errors = {}
    sharp = views(blurred=None)[BLURRED]
    truth = torch.from_numpy(sharp.load()[0].astype(np.float32) / 255)
    for name, formation in (("plain", None), ("formed", CaptureFormation([views()[BLURRED]], LOOK))):
        trained = run(tmp_path / name, [views()[BLURRED]], formation)
        errors[name] = float((render_formed(trained.scene, sharp) - truth).square().mean())
    assert errors["formed"] < 0.1 * errors["plain"]


def test_sharp_frames_train_as_without_it_bit_for_bit(tmp_path: Path) -> None:
    seen = views(blurred=None)
    formation = CaptureFormation(seen, LOOK)
    with_it, without = run(tmp_path / "a", seen, formation), run(tmp_path / "b", seen, None)
    assert {frame.model for frame in formation.frames.values()} == {"none"}
    for name, tensor in without.scene.gaussians.tensors().items():
        assert torch.equal(tensor, with_it.scene.gaussians.tensors()[name]), name
    assert with_it.rows.equals(without.rows)


@pytest.fixture
def searched(monkeypatch: pytest.MonkeyPatch) -> list[FramePair]:
    """Return the frames that are searched, in order, while the search still runs."""
    pairs: list[FramePair] = []

    def counted(pair: FramePair, **settings: Any) -> list[MotionFit]:
        pairs.append(pair)
        return search(pair, **settings)

    monkeypatch.setattr(estimate, "search", counted)
    return pairs


MAJORITY = MIN_TESTED_FRAMES // 2 + 1
"""Frames without a skew after which no more are tested."""
NO_TEST = 0.001
"""A gain of skews, measured before: the shutter is not asked for again."""


def known(**blurs: FrameMotion) -> dict[int, FrameFormation]:
    """Return what an earlier training found: ``f2=BLUR``."""
    still = {k: FrameFormation(k, skew_gain=NO_TEST, steps=LOOK.every) for k in range(FRAMES)}
    moved = {int(name[1:]): motion for name, motion in blurs.items()}
    return still | {
        k: FrameFormation(
            k, motion, "blur", blur_px=7.0, displacement_px=4.0, skew_gain=NO_TEST, steps=LOOK.every
        )
        for k, motion in moved.items()
    }


def test_every_frame_is_searched_at_the_first_look(tmp_path: Path, searched: list[FramePair]) -> None:
    first = {k: FrameFormation(k, skew_gain=NO_TEST) for k in range(FRAMES)}
    formation = CaptureFormation(views(), LOOK, known=first)
    run(tmp_path, views(), formation)
    assert formation.frames[BLURRED].blur_px == pytest.approx(7.0, abs=1.0)
    assert len(searched) == FRAMES


def test_a_draft_searches_only_frames_with_evidence(tmp_path: Path, searched: list[FramePair]) -> None:
    first = {k: FrameFormation(k, skew_gain=NO_TEST) for k in range(FRAMES)}
    formation = CaptureFormation(views(), DRAFT, known=first)
    run(tmp_path, views(), formation)
    assert formation.frames[BLURRED].blur_px == pytest.approx(7.0, abs=1.0)
    assert len(searched) == 1


@pytest.mark.parametrize(("modelled", "searches"), [(0, 1), (2, 2)])
def test_a_sharp_capture_is_searched_only_where_there_is_evidence(
    modelled: int, searches: int, tmp_path: Path, searched: list[FramePair], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four frames were looked at. Two were not, of which one is blurred."""
    monkeypatch.setattr(capture, "MIN_SEARCHED_FRAMES", 4)
    monkeypatch.setattr(capture, "SHARP_SHARE", 1 / 4)
    looked = known(**{f"f{k}": FrameMotion(blur=np.zeros(6)) for k in range(4, 4 + modelled)})
    steps = {k: 0 if k in (0, BLURRED) else LOOK.every + 1 for k in looked}  # their next look is later
    first = {k: replace(frame, steps=steps[k]) for k, frame in looked.items()}
    formation = CaptureFormation(views(), LOOK, known=first)
    run(tmp_path, views(), formation)
    assert formation.frames[BLURRED].blur_px == pytest.approx(7.0, abs=1.0)
    assert len(searched) == searches


def test_later_only_a_frame_with_evidence_is_searched(tmp_path: Path, searched: list[FramePair]) -> None:
    """After that its motion is followed."""
    formation = CaptureFormation(views(), LOOK, known=known())
    run(tmp_path, views(), formation)
    assert formation.frames[BLURRED].blur_px == pytest.approx(7.0, abs=1.0)
    assert formation.frames[BLURRED].steps > 2 * LOOK.every
    assert len(searched) == 1


def test_a_frame_is_not_searched_if_the_blur_of_the_test_makes_it_worse(
    tmp_path: Path, searched: list[FramePair], monkeypatch: pytest.MonkeyPatch
) -> None:
    """All frames have noise. The test is replaced by one that sees a blur of 7 px across in each."""
    found = MissingBlur(line_gain=0.2, line=49.0 / 12.0, angle=0.0, disc_gain=0.0, disc=0.0)
    monkeypatch.setattr(estimate, "missing_blur", lambda *_: found)
    rng = np.random.default_rng(0)
    seen = []
    for view in views():
        noisy = view.load()[0] + rng.normal(0.0, 8.0, (HEIGHT, WIDTH, 3))
        pixels = np.clip(noisy, 0, 255).astype(np.uint8)
        seen.append(replace(view, load=lambda pixels=pixels: (pixels, None)))
    formation = CaptureFormation(seen, DRAFT, known=known())
    run(tmp_path, seen, formation)
    assert formation.frames[0].residual > MIN_RESIDUAL
    assert formation.frames[BLURRED].blur_px == pytest.approx(7.0, abs=1.0)
    assert len(searched) == 1


def test_blur_that_the_last_search_left_is_not_searched_again(
    tmp_path: Path, searched: list[FramePair]
) -> None:
    """It explains most of the error of the frame, as it did after that search."""
    first = known()
    first[BLURRED] = replace(first[BLURRED], blur_gain=1.0)
    formation = CaptureFormation(views(), LOOK, known=first)
    run(tmp_path, views(), formation)
    assert not searched
    assert 0.0 < formation.frames[BLURRED].blur_gain < 1.0  # the share that is left


def test_what_is_known_is_not_searched_again(tmp_path: Path, searched: list[FramePair]) -> None:
    formation = CaptureFormation(views(), LOOK, known=known(f2=BLUR))
    run(tmp_path, views(), formation)
    assert formation.frames[BLURRED].blur_px == pytest.approx(7.0, abs=1.0)
    assert not searched


def test_a_motion_that_no_longer_explains_its_frame_is_searched_again(
    tmp_path: Path, searched: list[FramePair]
) -> None:
    """The known blur goes down, the frame's across."""
    other = FrameMotion(blur=np.array([0, 0, 0, 7.0, 0, 0]), median_depth=3.0)
    formation = CaptureFormation(views(), LOOK, known=known(f2=other))
    run(tmp_path, views(), formation)
    found = formation.frames[BLURRED]
    assert abs(found.motion.blur[4]) == pytest.approx(7.0, abs=1.0) and abs(found.motion.blur[3]) < 1.0
    assert searched


def test_a_later_training_keeps_what_was_looked_at_often(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A frame that was looked at less often is looked at again."""
    looked: list[int] = []

    def look(frame: FrameFormation, *_: Any, **__: Any) -> FrameFormation:
        looked.append(frame.frame_id)
        return frame

    monkeypatch.setattr(capture, "fit_motion", look)
    often = {
        k: replace(frame, steps=(ESTIMATES_TO_KEEP - 1) * LOOK.every + 1)
        for k, frame in known(f2=BLUR).items()
    }
    often[0] = replace(often[0], steps=(ESTIMATES_TO_KEEP - 1) * LOOK.every)
    formation = CaptureFormation(views(), LOOK, known=often)
    run(tmp_path, views(), formation)
    assert set(looked) == {0}
    assert formation.frames[BLURRED].steps > often[BLURRED].steps  # its steps are counted
    np.testing.assert_array_equal(formation.frames[BLURRED].motion.vector, BLUR.vector)


def test_frames_of_a_rolling_shutter_are_kept_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A search in a short later training would put a worse motion in place of the known one."""
    looked: list[int] = []

    def look(frame: FrameFormation, *_: Any, **__: Any) -> FrameFormation:
        looked.append(frame.frame_id)
        return frame

    monkeypatch.setattr(capture, "fit_motion", look)
    steps = ESTIMATES_TO_KEEP * LOOK.every
    rolling = {k: FrameFormation(k, BLUR, "blur", skew_gain=0.2, steps=steps) for k in range(FRAMES)}
    run(tmp_path, views(), CaptureFormation(views(), LOOK, known=rolling))
    assert not looked


def test_the_next_training_counts_on_and_does_not_search(tmp_path: Path, searched: list[FramePair]) -> None:
    first = CaptureFormation(views(), LOOK)
    run(tmp_path, views(), first)
    write_formation(tmp_path / "formation.parquet", first, dict.fromkeys(range(FRAMES), 1.0))
    frames, _ = read_formation(tmp_path / "formation.parquet")
    second = CaptureFormation(views(), LOOK, known=frames)
    assert all(frame.steps == first.frames[k].steps > 0 for k, frame in second.frames.items())
    searched.clear()
    run(tmp_path / "second", views(), second)
    assert not searched


def crossed() -> list[TrainingView]:
    """The sharp views, with a red square that stands elsewhere in each."""
    made = []
    for view in views(blurred=None):
        pixels = view.load()[0].copy()
        left = 8 + 17 * view.frame_id
        pixels[24:40, left : left + 16] = (230, 20, 20)
        made.append(
            TrainingView(view.frame_id, view.camera, 1.0, "real", lambda pixels=pixels: (pixels, None))
        )
    return made


def test_what_moves_teaches_little(tmp_path: Path) -> None:
    """Every place is covered in one view of five at most; without masks a fifth of the red stays.

    The first looks have no witnesses, so that a little is learned before the masks are there.
    """
    errors = {}
    for name, tolerance, motions in (("plain", 0.0, True), ("masked", 0.05, True), ("alone", 0.05, False)):
        look = FormationConfig(start=0.0, enabled=motions)
        formation = CaptureFormation(crossed(), look, tolerance=tolerance)
        trained = run(tmp_path / name, crossed(), formation)
        shown = [render_formed(trained.scene, view) - render_formed(scene(), view) for view in crossed()]
        errors[name] = float(torch.stack(shown).square().mean())
    assert errors["masked"] < 0.2 * errors["plain"], errors
    assert errors["alone"] < 0.2 * errors["plain"], errors


def test_a_repair_does_not_teach_where_its_frame_moves() -> None:
    cells = np.zeros((round(CELLS * HEIGHT / WIDTH), CELLS), np.bool_)
    cells[10:18, 20:30] = True
    formation = CaptureFormation(views(), FormationConfig(start=1.0), moving={1: cells})
    target, mask = torch.zeros(HEIGHT, WIDTH, 3), torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    mask[:, :5] = False
    for kind in ("real", "pseudo"):
        view = replace(views()[1], kind=kind)
        formed = formation.form(view, 1.0, 0.0, target, mask, lambda camera: pytest.fail("no look is due"))
        assert formed is not None and formed.mask is not None
        expected = mask & torch.from_numpy(static_pixels(cells, HEIGHT, WIDTH))
        assert torch.equal(formed.mask, expected) and not bool(expected.all())
    other = formation.form(views()[2], 1.0, 0.0, target, mask, lambda camera: pytest.fail("no look is due"))
    assert other is None


def test_where_nothing_moves_a_training_has_the_bits_of_one_without_looks(tmp_path: Path) -> None:
    seen, scenes = views(blurred=None), []
    for name, tolerance in (("off", 0.0), ("on", 0.05)):
        formation = CaptureFormation(seen, FormationConfig(enabled=False), tolerance=tolerance)
        scenes.append(run(tmp_path / name, seen, formation).scene.gaussians.tensors())
    assert all(torch.equal(tensor, scenes[1][name]) for name, tensor in scenes[0].items())


@pytest.mark.parametrize("motion", [BLUR, BENT], ids=["straight", "curved"])
def test_a_resumed_training_is_the_same(
    motion: FrameMotion, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = [replace(view, estimated=True) for view in views(motion=motion)]

    def formation() -> CaptureFormation:
        return CaptureFormation(seen, LOOK, exposure=Exposure.identity(range(FRAMES)), lr_exposure=1e-3)

    whole = run(tmp_path / "whole", seen, formation())
    step, steps = Trainer.step, iter(range(40))

    def killed(trainer: Trainer) -> None:
        if next(steps, None) is None:
            raise KeyboardInterrupt
        step(trainer)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Trainer, "step", killed)
        run(tmp_path / "cut", seen, formation())
    resumed = run(tmp_path / "cut", seen, formation())
    assert whole.state.keys() == resumed.state.keys()
    for name, tensor in whole.state.items():
        assert torch.equal(tensor, resumed.state[name]), name


def test_a_checkpoint_of_another_formation_is_not_taken(tmp_path: Path) -> None:
    first = Trainer(scene(), views(), CONFIG, seed=(3,), formation=CaptureFormation(views(), LOOK))
    other = FormationConfig(start=0.0, every=5)
    second = Trainer(scene(), views(), CONFIG, seed=(3,), formation=CaptureFormation(views(), other))
    assert not second.matches(first.state())


SKEW = FrameMotion(skew=np.array([0, 0, 0, 0, 9.0, 0]), median_depth=3.0)


def skewed(frames: list[int]) -> list[TrainingView]:
    """The views, with a rolling shutter in these."""
    made = []
    for view in views(blurred=None):
        moved = FrameFormation(view.frame_id, SKEW, "skew", displacement_px=5.0)
        seen = render_formed(scene(), view, formation=moved if view.frame_id in frames else None).numpy()
        pixels = np.rint(255 * seen).astype(np.uint8)
        made.append(
            TrainingView(view.frame_id, view.camera, 1.0, "real", lambda pixels=pixels: (pixels, None))
        )
    return made


def test_a_twist_is_the_motion_of_the_scene_past_the_camera() -> None:
    """The last rows of a skewed frame are those of a camera turned by half the skew."""
    view = views(blurred=None)[2]
    moved = FrameFormation(2, SKEW, "skew", displacement_px=5.0)
    seen = render_formed(scene(), view, formation=moved)[-4:, 8:-8]
    difference = {}
    for side in (-1, 1):
        turned = TrainingView(2, camera(side * 0.5 * 9.0 / 90.0), 1.0, "real", view.load)
        difference[side] = float((render_formed(scene(), turned)[-4:, 8:-8] - seen).abs().mean())
    # The four rows lie up to a 0.3 px short of it, where the squares have edges.
    assert difference[1] < 0.4 * difference[-1], difference


@pytest.mark.parametrize("frames", [[0, 1, 2, 3, 4], [1]])
def test_a_shutter_rolls_in_the_whole_capture_or_not_at_all(tmp_path: Path, frames: list[int]) -> None:
    """A single skewed frame has a wrong pose, or something moved in it."""
    formation = CaptureFormation(skewed(frames), FormationConfig(start=0.0, every=3))
    run(tmp_path, skewed(frames), formation)
    gains = {k: frame.skew_gain for k, frame in formation.frames.items() if frame.skew_gain is not None}
    assert 1 in gains and all(gain > 0.1 for k, gain in gains.items() if k in frames), gains
    found = {k for k, frame in formation.frames.items() if frame.model in ("skew", "both")}
    assert found == (set(range(FRAMES)) if len(frames) == FRAMES else set())


def test_a_rolling_shutter_is_asked_for_before_anything_else(tmp_path: Path) -> None:
    """A scene that has learnt to look like its skewed frames hides their skew."""
    for name, seen, rolling in (("skewed", skewed([0, 1, 2, 3, 4]), True), ("blurred", views(), False)):
        formation = CaptureFormation(seen, FormationConfig(start=1.0, every=3))
        trained = run(tmp_path / name, seen, formation)
        tested = sum(frame.skew_gain is not None for frame in formation.frames.values())
        assert tested >= MIN_TESTED_FRAMES if rolling else tested == MAJORITY
        assert {frame.model for frame in formation.frames.values()} == {"skew" if rolling else "none"}
        plain = run(tmp_path / f"{name}-plain", seen, None)
        same = torch.equal(trained.scene.gaussians.sh, plain.scene.gaussians.sh)
        assert same != rolling, "asking costs a training no bit"


def test_after_each_round_of_looks_the_common_skew_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All frames get it at the same time, so that the scene can follow; a resumed training does the same."""
    rounds, seen, missing = [], skewed([0, 1, 2, 3, 4]), np.array([0, 0, 0, 0, 30.0, 0])

    class Speeds:
        def missing_skew(self, frames: dict[int, FrameFormation]) -> Any:
            rounds.append([frame.steps for frame in frames.values()])
            return missing if len(rounds) == 2 else None

    monkeypatch.setattr(CameraSpeeds, "of", lambda views: Speeds())
    formation = CaptureFormation(seen, LOOK)
    step, skews = Trainer.step, []

    def stepped(trainer: Trainer) -> None:
        step(trainer)
        skews.append([frame.motion.skew[4] for frame in formation.frames.values()])

    monkeypatch.setattr(Trainer, "step", stepped)
    run(tmp_path, seen, formation)
    # 60 steps on five frames, looked at after every fourth step on them.
    assert len(rounds) == 3
    for k, steps in enumerate(rounds):
        # The last frame of a round is counted after its look.
        assert sorted(steps) == [4 * k, *[4 * k + 1] * 4]
    jumps = np.diff(np.array(skews), axis=0)
    together = [k for k, jump in enumerate(jumps) if (jump > 20.0).all()]
    assert len(together) == 1, "all frames get it in one step, once"


def test_trust_is_earned() -> None:
    seen = views(weights=[1.0, 1.0, 0.2, 1.0, 0.1])
    known = {
        0: FrameFormation(0, residual=0.010, residual_without=0.010),
        1: FrameFormation(1, residual=0.012, residual_without=0.012),
        2: FrameFormation(2, BLUR, "blur", residual=0.016, residual_without=0.05),
        3: FrameFormation(3, residual=0.008, residual_without=0.008),
        4: FrameFormation(4, residual=0.05, residual_without=0.05),
    }
    formation = CaptureFormation(seen, LOOK, known=known)
    assert [formation.weight(k) for k in (0, 1, 3)] == [1.0, 1.0, 1.0]
    # The weights add up to 3.3; half of that is reached at the second of .008, .010, .012, .016 and .05.
    assert formation.weight(2) == pytest.approx(0.010 / 0.016)
    assert formation.weight(4) == pytest.approx(0.010 / 0.05)
    assert CaptureFormation(seen, LOOK).weight(4) == 0.1  # not compared with the scene so far: RVA's


def test_a_frame_without_a_fault_earns_trust_by_its_residual() -> None:
    """RVA gave soft close-ups of fur a tenth of the weight, and views near them lost 3 dB."""
    known = {k: FrameFormation(k, residual=0.010, residual_without=0.010, steps=1) for k in range(FRAMES)}
    seen = views(weights=[1.0, 1.0, 1.0, 1.0, 0.12])
    formation = CaptureFormation(seen, LOOK, known=known)
    assert formation.weight(4) == 1.0
    target = torch.zeros(HEIGHT, WIDTH, 3)
    # The training gets the weight, too. Frames whose weight is their own need nothing.
    formed = formation.form(seen[4], 1.0, 0.9, target, None, lambda camera: pytest.fail("no estimate is due"))
    assert formed is not None and formed.weight == 1.0 and not formed.needs_depth
    plain = formation.form(seen[3], 1.0, 0.9, target, None, lambda camera: pytest.fail("no estimate is due"))
    assert plain is None


def test_the_table_gives_back_what_was_found(tmp_path: Path) -> None:
    motion = FrameMotion(
        blur=np.arange(6.0),
        skew=-np.arange(6.0),
        pose=np.full(6, 0.5),
        disc_px=2.0,
        focus=1.5,
        median_depth=3.0,
    )
    frame = FrameFormation(2, motion, "both", 0.01, 0.02, 6.0, 3.0, 1.0, 5.0)
    formation = CaptureFormation(views(), LOOK, known={2: frame})
    write_formation(tmp_path / "formation.parquet", formation, dict.fromkeys(range(FRAMES), 1.0))
    back, weights = read_formation(tmp_path / "formation.parquet")
    assert weights == dict.fromkeys(range(FRAMES), 1.0)
    assert sorted(back) == list(range(FRAMES))
    assert back[2].model == "both"
    np.testing.assert_array_equal(back[2].motion.vector, motion.vector)
    assert (back[2].motion.disc_px, back[2].motion.focus, back[2].displacement_px) == (2.0, 1.5, 5.0)
    assert back[2].explained == 0.5


def test_a_frame_is_rendered_with_a_margin() -> None:
    """Content that moved in from outside the border is explained too."""
    seen = views()
    moved = FrameFormation(BLURRED, BLUR, "blur", displacement_px=4.0)
    wide = render_formed(scene(), seen[BLURRED], formation=moved)
    without = render_formed(scene(), seen[BLURRED], formation=FrameFormation(BLURRED, BLUR, "blur"))
    assert (wide - without)[4:-4, 8:-8].abs().max() < 1e-5
    assert (wide - without)[:, :2].abs().max() > 0.01
