"""The trainer: weights, masks, kinds of views, resumption, threads and errors."""

from __future__ import annotations

import math
import os
import signal
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.splat_toy import HEIGHT, WIDTH, gaussians, images, keep, refuse, start, views
from safetensors import SafetensorError

from cleargs.errors import InputError, StageError, StoreError
from cleargs.formation.capture import CaptureFormation
from cleargs.formation.exposure import Exposure, centred
from cleargs.formation.formed import render_formed
from cleargs.media.image import read_rgb, to_uint8
from cleargs.progress import PREVIEW, SilentReporter
from cleargs.scene.measure import ViewPsnr, evaluate_views, pooled_unseen
from cleargs.splat import training as training_module
from cleargs.splat.backend import LossAccumulator, set_threads
from cleargs.splat.config import FormationConfig, TrainConfig
from cleargs.splat.formation import clip_to_saturation
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.render import render
from cleargs.splat.scene import Scene
from cleargs.splat.state import load_state, read_moments, save_state
from cleargs.splat.tables import TRAIN
from cleargs.splat.trainer import Trainer
from cleargs.splat.training import Trained
from cleargs.splat.training import run as run_training
from cleargs.splat.types import Moments, Render
from cleargs.splat.views import ImageCache, TrainingView, unseen_pixels

CONFIG = TrainConfig(
    steps=40,
    refine_every=5 / 40,
    refine_start=0.1,
    budget=80,
    checkpoint_interval=7,
    sh_every=10 / 40,
    lr_means=2e-3,
)


class Listener(SilentReporter):
    """Reporter that stores warnings."""

    def __init__(self) -> None:
        self.warnings: list[str] = []

    def warn(self, text: str) -> None:
        self.warnings.append(text)


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    made = images(gaussians(), 6)
    assert all(20 < image.mean() < 235 and image.std() > 20 for image in made)
    return made


def run(pictures_or_views: Any, folder: Path, config: TrainConfig = CONFIG, **options: Any) -> Trained:
    made = pictures_or_views if isinstance(pictures_or_views[0], TrainingView) else views(pictures_or_views)
    folder.mkdir(exist_ok=True)
    arguments = {"scene": start(sh_degree=1), "seed": (7,), "reporter": SilentReporter()} | options
    scene, reporter, round = arguments.pop("scene"), arguments.pop("reporter"), arguments.pop("round", 0)
    trainer = Trainer(scene, made, config, **arguments)
    return run_training(trainer, checkpoint=folder / "state.safetensors", reporter=reporter, round=round)


def affines(weights: list[float] | None = None, rate: float = CONFIG.lr_exposure) -> CaptureFormation:
    """Exposure compensation of six frames, without motion."""
    seen = views([np.empty(0)] * 6, weights=weights)
    return CaptureFormation(
        seen, FormationConfig(enabled=False), exposure=Exposure.identity(range(6)), lr_exposure=rate
    )


def assert_same(first: Trained, second: Trained) -> None:
    assert first.rows.equals(second.rows)
    assert first.state.keys() == second.state.keys()
    for name, tensor in first.state.items():
        assert torch.equal(tensor, second.state[name]), name


def test_training_reduces_the_error(pictures: list[np.ndarray], tmp_path: Path) -> None:
    before = evaluate_views(start(sh_degree=1), views(pictures))
    trained = run(pictures, tmp_path, CONFIG.model_copy(update={"steps": 200, "refine_every": 5 / 200}))
    after = evaluate_views(trained.scene, views(pictures))
    # Random blobs start near 12 dB. 200 steps gain far more than 5 dB. An optimiser that ignores one
    # parameter gains less, and one with a wrong sign loses.
    gain = np.mean([fit.psnr for fit in after]) - np.mean([fit.psnr for fit in before])
    assert gain > 5.0
    assert trained.scene.gaussians.num == 80
    rows = trained.rows
    assert rows.schema.equals(TRAIN)
    assert rows.column("n_gaussians").to_pylist()[0] == 60
    assert rows.column("sh_degree").to_pylist()[0] == 0
    assert rows.column("sh_degree").to_pylist()[-1] == 1
    assert rows.column("width").to_pylist()[0] == WIDTH // 2
    assert rows.column("height").to_pylist()[-1] == HEIGHT
    assert set(rows.column("frame_id").to_pylist()) == set(range(6))


def test_what_was_filmed_becomes_opaque(tmp_path: Path) -> None:
    """Black behind the scene explains a dark photograph as well as an opaque Gaussian does."""
    dark = [np.full((HEIGHT, WIDTH, 3), 40, np.uint8)] * 6
    config = CONFIG.model_copy(update={"steps": 200, "refine_every": 5 / 200})
    config = config.model_copy(update={"opacity_reg": 0.0})
    alphas = []
    for name, background in (("random", None), ("black", (0.0, 0.0, 0.0))):
        trained = run(dark, tmp_path / name, config.model_copy(update={"background": background}))
        assert trained.scene.background == (0.0, 0.0, 0.0)
        shown = [render(trained.scene.gaussians, view.camera).alpha for view in views(dark)]
        alphas.append(float(torch.stack(shown).mean()))
    assert alphas[0] > 0.99 and alphas[1] < 0.9  # measured: 0.999 and 0.837


def test_saturated_pixels_do_not_darken_the_scene(pictures: list[np.ndarray], tmp_path: Path) -> None:
    exposed = np.stack([np.eye(3, 4) * (2.0 if index % 2 else 1.0) for index in range(6)])
    filmed = [
        to_uint8(np.clip(exposed[i, 0, 0] * picture / 255.0, 0, 1)) for i, picture in enumerate(pictures)
    ]
    seen = views(filmed)
    formation = CaptureFormation(
        seen, FormationConfig(enabled=False), exposure=Exposure(np.arange(6, dtype=np.int32), exposed)
    )
    still = CONFIG.model_copy(
        update={
            "densify": "off",
            "noise": 0.0,
            "opacity_reg": 0.0,
            "scale_reg": 0.0,
            "coarse_share": 0.0,
            "background": (0.0, 0.0, 0.0),
        }
    )
    trained = run(seen, tmp_path, still, scene=Scene(gaussians()), formation=formation)
    shown = [render(trained.scene.gaussians, view.camera).image.numpy() for view in seen]
    truth = np.stack(pictures) / 255.0
    lost = truth > 0.5  # the gain of 2 clips these
    assert lost.mean() > 0.05
    assert (truth - np.stack(shown))[lost].mean() < 0.01  # 0.002; 0.036 with a loss at clipped channels


def test_a_saturated_channel_bounds_the_render_from_below() -> None:
    target = torch.tensor([[[1.0, 1.0, 0.5], [254 / 255, 0.9, 0.0]]])
    image = torch.tensor([[[1.3, 0.8, 0.7], [1.1, 1.2, 0.1]]])
    image_recorded, clipped = clip_to_saturation(image, target)
    assert clipped.tolist() == [[[True, False, False], [True, False, False]]]
    assert torch.equal(image_recorded, torch.where(clipped, target, image))


def test_a_schedule_in_parts_equals_the_whole(pictures: list[np.ndarray], tmp_path: Path) -> None:
    """Rates, growth, SH degree, image size, noise and steps of Adam continue from the part before."""
    one = views(pictures[:1])  # each part has a different order of views
    whole = run(one, tmp_path / "whole")
    ends = (0.0, 0.2, 0.75, 1.0)  # not within steps that measure errors, which a part does not hand over
    scene, moments, rows = start(sh_degree=1), None, []
    for number, (begin, end) in enumerate(pairwise(ends)):
        part = CONFIG.model_copy(update={"steps": round(40 * (end - begin)), "begin": begin, "end": end})
        done = run(one, tmp_path / f"part{number}", part, scene=scene, moments=moments)
        save_state(tmp_path / "state.safetensors", done.state)
        scene, moments = done.scene, read_moments(tmp_path / "state.safetensors", done.scene.gaussians)
        rows += done.rows.to_pylist()
    for name, tensor in whole.scene.gaussians.tensors().items():
        assert torch.equal(tensor, getattr(scene.gaussians, name)), name
    columns = ("loss", "n_gaussians", "sh_degree", "width")
    assert [[row[name] for name in columns] for row in rows] == [
        [row[name] for name in columns] for row in whole.rows.to_pylist()
    ]


def test_moments_of_another_scene_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "state.safetensors"
    with pytest.raises(StoreError, match="cannot read"):
        read_moments(path, start().gaussians)
    save_state(path, {"step": torch.tensor(0)})
    with pytest.raises(StoreError, match="do not fit the scene"):
        read_moments(path, start().gaussians)
    save_state(path, Moments.zeros(start(59).gaussians).state())
    with pytest.raises(StoreError, match="do not fit the scene"):
        read_moments(path, start().gaussians)


def test_a_state_may_be_read_by_whoever_may_read_other_files(tmp_path: Path) -> None:
    save_state(tmp_path / "state.safetensors", {"step": torch.tensor(0)})
    (tmp_path / "other").touch()
    assert (tmp_path / "state.safetensors").stat().st_mode == (tmp_path / "other").stat().st_mode


def test_a_full_disk_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise SafetensorError("Error while serializing: I/O error: No space left on device (os error 28)")

    monkeypatch.setattr("cleargs.splat.state.save_file", full)
    with pytest.raises(StoreError, match="no space left on the disk"):
        save_state(tmp_path / "state.safetensors", {"step": torch.tensor(0)})
    assert not list(tmp_path.iterdir())


def test_a_part_ends_after_its_begin() -> None:
    with pytest.raises(ValueError, match="must be greater than begin"):
        TrainConfig(begin=0.9, end=0.9)


def test_weights_of_one_change_no_bit(
    pictures: list[np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    weighted = run(views(pictures, weights=[1.0] * 6), tmp_path / "a")

    def without_weight(losses: LossAccumulator, *images: Any, weight: float, **options: Any) -> None:
        add(losses, *images, weight=1.0, **options)

    add = LossAccumulator.add
    monkeypatch.setattr(LossAccumulator, "add", without_weight)
    assert_same(weighted, run(pictures, tmp_path / "b"))
    for row in weighted.rows.to_pylist():
        unweighted = (1.0 - CONFIG.ssim_lambda) * row["l1"] + CONFIG.ssim_lambda * (1.0 - row["ssim"])
        assert row["loss"] == unweighted


def test_a_weight_multiplies_the_loss(pictures: list[np.ndarray], tmp_path: Path) -> None:
    full = Trainer(start(), views(pictures), CONFIG, seed=(7,))
    half = Trainer(start(), views(pictures, weights=[0.5] * 6), CONFIG, seed=(7,))
    full.step()
    half.step()
    first, second = full.rows(0).to_pylist()[0], half.rows(0).to_pylist()[0]
    assert second["loss"] == pytest.approx(0.5 * first["loss"], rel=1e-12)
    assert second["l1"] == first["l1"]
    # The first moment after one step is a tenth of the gradient, so it is proportional to the weight.
    moments = [trainer.state()["first.sh"].numpy() for trainer in (full, half)]
    np.testing.assert_allclose(moments[1], 0.5 * moments[0], rtol=1e-4, atol=1e-9)
    assert np.abs(moments[0]).max() > 0


def test_weight_zero_is_never_decoded(pictures: list[np.ndarray], tmp_path: Path) -> None:
    made = views(pictures)
    dropped = replace(made[2], weight=0.0, load=refuse)
    with_it = run([*made[:2], dropped, *made[3:]], tmp_path / "a")
    assert_same(with_it, run([*made[:2], *made[3:]], tmp_path / "b"))
    with pytest.raises(InputError, match="weight"):
        run([dropped], tmp_path / "c")


def test_masked_pixels_contribute_nothing(pictures: list[np.ndarray], tmp_path: Path) -> None:
    mask = np.ones((HEIGHT, WIDTH), np.bool_)
    mask[5:15, 8:30] = False
    results = []
    for index, value in enumerate((0, 255)):
        made = []
        for view, picture in zip(views(pictures), pictures, strict=True):
            painted = picture.copy()
            painted[~mask] = value
            made.append(replace(view, load=keep(painted, mask)))
        # Reduced images mix neighbours. A reduced pixel counts only if it covers no masked pixel.
        results.append(run(made, tmp_path / str(index)))
    assert_same(*results)


LOOKING = CONFIG.model_copy(update={"refine_every": 16 / 40})
"""Refinements after 16 and 32 steps, each with the errors of the two steps before."""


def looking(scene: Scene, pictures: list[np.ndarray]) -> Trainer:
    trainer = Trainer(scene, views(pictures), LOOKING, seed=(1,))
    while trainer.done < 15:
        trainer.step()
    return trainer


def test_the_render_of_a_look_serves_the_step_too(
    pictures: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A look sees the scene over black, and the step the same render over its colour."""
    looks: list[torch.Tensor] = []

    class Looking(CaptureFormation):
        def form(self, view: TrainingView, factor: float, *rest: Any) -> Any:
            looks.append(rest[-1](view.camera.scaled(factor)).image.clone())
            return super().form(view, factor, *rest)

    config = CONFIG.model_copy(update={"coarse_share": 0.0})
    formation = Looking(views(pictures), FormationConfig(enabled=False))
    trainer = Trainer(start(), views(pictures), config, seed=(7,), formation=formation)
    plain = Trainer(start(), views(pictures), config, seed=(7,))
    made: list[Render] = []
    keep_render = trainer._rasteriser.view
    monkeypatch.setattr(
        trainer._rasteriser, "view", lambda *a, **k: made.append(keep_render(*a, **k)) or made[-1]
    )
    for number in range(8):
        camera = trainer._view(number).camera
        over_black = render(trainer.scene.gaussians, camera, sh_degree=trainer._sh_degree()).image
        trainer.step()
        plain.step()
        assert len(made) == number + 1
        torch.testing.assert_close(looks[-1], over_black, atol=1e-6, rtol=0.0)  # float32, up to 1.5
    for name, tensor in plain.scene.gaussians.tensors().items():
        assert torch.equal(tensor, trainer.scene.gaussians.tensors()[name]), name


def test_errors_go_to_the_gaussians_that_cause_them(pictures: list[np.ndarray]) -> None:
    """One Gaussian of the true scene has the wrong colour, and a rate of 0."""
    wrong = gaussians()
    rates = dict.fromkeys(("lr_means", "lr_scales", "lr_rotations", "lr_opacities", "lr_sh"), 0.0)
    # The pictures show transparent blobs over black.
    still = LOOKING.model_copy(update={**rates, "background": (0.0, 0.0, 0.0)})

    def charged(scene: Gaussians) -> np.ndarray:
        trainer = Trainer(Scene(scene), views(pictures), still, seed=(1,))
        while trainer.done < 15:
            trainer.step()
        return trainer.state()["strategy.errors"].numpy()

    hidden = charged(gaussians())
    shown = int(hidden.argmax())
    wrong.sh[shown] *= -1.0
    errors = charged(wrong)
    assert errors.argmax() == shown
    # The true scene has a small error, because images are stored in steps of 1/255.
    assert hidden.sum() < 0.01 * errors.sum()


def test_resuming_with_pending_errors_changes_no_bit(pictures: list[np.ndarray]) -> None:
    whole = looking(start(), pictures)
    saved = {name: tensor.clone() for name, tensor in whole.state().items()}
    assert "strategy.errors" in saved
    resumed = Trainer(start(), views(pictures), LOOKING, seed=(1,))
    resumed.restore(saved)
    for continued in (whole, resumed):
        while continued.done < 20:
            continued.step()
    assert whole.scene.gaussians.num > start().gaussians.num
    for name, tensor in whole.scene.gaussians.tensors().items():
        assert torch.equal(tensor, resumed.scene.gaussians.tensors()[name]), name


def test_resuming_changes_no_bit(
    pictures: list[np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training_module, "_SHORT_SAVE", math.inf)  # a slow disk would leave checkpoints out
    whole = run(pictures, tmp_path / "whole", formation=affines())
    step = Trainer.step

    def die(trainer: Trainer) -> None:
        if trainer.done == 24:
            raise KeyboardInterrupt
        step(trainer)

    monkeypatch.setattr(Trainer, "step", die)
    with pytest.raises(KeyboardInterrupt):
        run(pictures, tmp_path / "cut", formation=affines())
    monkeypatch.setattr(Trainer, "step", step)
    saved = load_state(tmp_path / "cut" / "state.safetensors", SilentReporter())
    assert saved is not None
    assert int(saved["step"]) == 21  # the last multiple of the interval
    assert_same(whole, run(pictures, tmp_path / "cut", formation=affines()))


def test_sigterm_leads_to_a_checkpoint(
    pictures: list[np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Step 10 is not a multiple of the interval, so the signal caused the checkpoint."""
    whole = run(pictures, tmp_path / "whole")
    take = Trainer.step

    def step(trainer: Trainer) -> None:
        take(trainer)
        if trainer.done == 10:
            os.kill(os.getpid(), signal.SIGTERM)

    def answer(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Trainer, "step", step)
    before = signal.signal(signal.SIGTERM, answer)
    try:
        with pytest.raises(KeyboardInterrupt):
            run(pictures, tmp_path / "cut")
        assert signal.getsignal(signal.SIGTERM) is answer
    finally:
        signal.signal(signal.SIGTERM, before)
    monkeypatch.undo()
    saved = load_state(tmp_path / "cut" / "state.safetensors", SilentReporter())
    assert saved is not None and int(saved["step"]) == 10
    assert_same(whole, run(pictures, tmp_path / "cut"))


def test_a_damaged_checkpoint_is_ignored(pictures: list[np.ndarray], tmp_path: Path) -> None:
    whole = run(pictures, tmp_path)
    checkpoint = tmp_path / "state.safetensors"
    checkpoint.write_bytes(checkpoint.read_bytes()[:-100])
    listener = Listener()
    assert_same(whole, run(pictures, tmp_path, reporter=listener))
    assert len(listener.warnings) == 1
    assert "damaged" in listener.warnings[0]


def test_a_checkpoint_of_another_training_is_ignored(pictures: list[np.ndarray], tmp_path: Path) -> None:
    run(pictures, tmp_path, CONFIG.model_copy(update={"steps": 30}))
    listener = Listener()
    assert_same(run(pictures, tmp_path / "fresh"), run(pictures, tmp_path, reporter=listener))
    assert "another" in listener.warnings[0]


@pytest.mark.parametrize("changed", ["pose", "background"])
def test_a_checkpoint_of_another_capture_is_ignored(
    changed: str, pictures: list[np.ndarray], tmp_path: Path
) -> None:
    run(pictures, tmp_path)
    seen, scene = views(pictures), start(sh_degree=1)
    if changed == "pose":
        moved = seen[0].camera.world_to_camera.copy()
        moved[0, 3] += 0.1
        seen[0] = replace(seen[0], camera=replace(seen[0].camera, world_to_camera=moved))
    else:
        scene = replace(scene, background=(1.0, 1.0, 1.0))
    listener = Listener()
    run(seen, tmp_path, scene=scene, reporter=listener)
    assert "another" in listener.warnings[0]


def test_fully_masked_frames_do_not_affect_the_mean_psnr(pictures: list[np.ndarray], tmp_path: Path) -> None:
    """The PSNR of a fully masked frame is infinite; masks of real captures can cover whole frames."""
    seen = views(pictures)
    nothing = np.zeros((HEIGHT, WIDTH), bool)
    seen[0] = replace(seen[0], load=lambda: (pictures[0], nothing))
    made = Trainer(start(sh_degree=1), seen, CONFIG, seed=(7,))
    for _ in range(12):
        made.step()
    assert np.isfinite(made.last_psnr)


def test_threads_change_no_bit(pictures: list[np.ndarray], tmp_path: Path) -> None:
    results = []
    for threads in (1, 2):
        set_threads(threads)
        results.append(run(pictures, tmp_path / str(threads), formation=affines()))
    assert_same(*results)


def test_the_cache_changes_no_bit(pictures: list[np.ndarray], tmp_path: Path) -> None:
    floats = [replace(view, load=keep(view.load()[0].astype(np.float32) / 255.0)) for view in views(pictures)]
    assert_same(
        run(floats, tmp_path / "a"), run(floats, tmp_path / "b", CONFIG.model_copy(update={"cache_mb": 0}))
    )
    calls = []

    def count() -> tuple[np.ndarray, None]:
        calls.append(1)
        return pictures[0], None

    view = replace(views(pictures)[0], load=count)
    for limit, expected in ((10**6, 1), (10, 3)):
        calls.clear()
        cache = ImageCache(limit)
        for _ in range(3):
            assert np.array_equal(cache.get(view)[0].numpy(), pictures[0] / np.float32(255))
        assert len(calls) == expected


def test_unseen_pixels_measure_quality_without_training(pictures: list[np.ndarray], tmp_path: Path) -> None:
    """Different unseen pixels give the same scene, but another PSNR of these pixels."""
    painted = []
    for frame_id, picture in enumerate(pictures):
        changed = picture.copy()
        changed[unseen_pixels(frame_id, HEIGHT, WIDTH)] = 255 - frame_id
        painted.append(changed)
    config = CONFIG.model_copy(update={"coarse_share": 0.5})  # reduced images too
    trained = run(pictures, tmp_path / "a", config)
    assert_same(trained, run(painted, tmp_path / "b", config))
    seen, other = (evaluate_views(trained.scene, views(which)) for which in (pictures, painted))
    assert all(a.unseen > b.unseen + 1.0 for a, b in zip(seen, other, strict=True))
    assert pooled_unseen(seen) == pytest.approx(
        -10 * np.log10(np.mean([0.1 ** (fit.unseen / 10) for fit in seen]))
    )
    assert pooled_unseen([ViewPsnr(20.0, None)]) is None


def test_one_percent_of_each_frame_is_unseen() -> None:
    masks = [unseen_pixels(frame_id, 540, 960) for frame_id in range(20)]
    assert {int(mask.sum()) for mask in masks} == {12 * 7 * 64}
    assert np.mean(masks) == pytest.approx(0.01, rel=0.05)
    # Masks differ between frames: few of 20 masks share a pixel. Each mask is reproducible.
    assert np.sum(masks, axis=0).max() <= 6
    assert np.array_equal(masks[3], unseen_pixels(3, 540, 960))
    assert not unseen_pixels(0, 15, 400).any()
    assert unseen_pixels(0, 16, 16).sum() == 64


def test_pseudo_views_get_their_share_and_weight(pictures: list[np.ndarray], tmp_path: Path) -> None:
    made = views(pictures)
    repaired = [replace(view, kind="pseudo") for view in made[:2]]
    trained = run([*made, *repaired], tmp_path / "a", pseudo_share=0.25, pseudo_weight=0.5, round=3)
    rows = trained.rows.to_pylist()
    assert [row["kind"] for row in rows].count("pseudo") == CONFIG.steps // 4
    assert {row["weight"] for row in rows if row["kind"] == "pseudo"} == {0.5}
    assert {row["weight"] for row in rows if row["kind"] == "real"} == {1.0}
    assert {row["frame_id"] for row in rows if row["kind"] == "pseudo"} == {0, 1}
    assert {row["round"] for row in rows} == {3}
    # Each epoch of 6 real views uses each of them once.
    real = [row["frame_id"] for row in rows if row["kind"] == "real"]
    assert sorted(real[:6]) == sorted(real[6:12]) == list(range(6))
    assert real[:6] != real[6:12]
    assert_same(run(made, tmp_path / "b"), run(made, tmp_path / "c", pseudo_share=0.5))


def test_without_densification_the_number_stays(pictures: list[np.ndarray], tmp_path: Path) -> None:
    trained = run(pictures, tmp_path, CONFIG.model_copy(update={"densify": "off"}))
    assert trained.scene.gaussians.num == 60


def test_the_initial_scene_is_not_changed(pictures: list[np.ndarray], tmp_path: Path) -> None:
    scene = start()
    before = scene.gaussians.clone()
    run(pictures, tmp_path, scene=scene)
    for name, tensor in scene.gaussians.tensors().items():
        assert torch.equal(tensor, before.tensors()[name]), name


def test_nan_errors_name_step_and_parameter(pictures: list[np.ndarray], tmp_path: Path) -> None:
    with pytest.raises(StageError, match=r"log_scales.* step \d+"):
        run(pictures, tmp_path, CONFIG.model_copy(update={"lr_scales": math.inf}))


def test_a_finished_state_leaves_the_parameters_to_the_scene(
    pictures: list[np.ndarray], tmp_path: Path
) -> None:
    done = run(pictures, tmp_path)
    save_state(tmp_path / "finished.safetensors", done.state)
    assert not any(name.startswith("parameter.") for name in done.state)
    moments = read_moments(tmp_path / "finished.safetensors", done.scene.gaussians)
    assert moments.first["means"].abs().max() > 0


def poison(monkeypatch: pytest.MonkeyPatch, after: int, change: Callable[[Trainer], None]) -> None:
    """Damage every training after ``after`` steps."""
    step = Trainer.step

    def damaged(trainer: Trainer) -> None:
        step(trainer)
        if trainer.done == after:
            change(trainer)

    monkeypatch.setattr(Trainer, "step", damaged)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["means", "log_scales", "rotations", "logit_opacities", "sh"])
def test_the_last_good_checkpoint_survives_nan(
    name: str, value: float, pictures: list[np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    poison(monkeypatch, 16, lambda trainer: trainer.scene.gaussians.tensors()[name][3].fill_(value))
    # The fault is found at step 20, long before the next checkpoint and the end.
    config = CONFIG.model_copy(update={"steps": 60, "checkpoint_interval": 14, "refine_every": 1.0})
    with pytest.raises(StageError, match=rf"{name} is not finite in 1 of 60 Gaussians at step 20") as raised:
        run(pictures, tmp_path, config)
    assert "checkpoint is kept" in str(raised.value)
    saved = load_state(tmp_path / "state.safetensors", SilentReporter())
    assert saved is not None
    assert int(saved["step"]) == 14
    assert all(torch.isfinite(tensor.float()).all() for name, tensor in saved.items() if name != "log")


def test_previews_change_no_bit(
    pictures: list[np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A preview is a render of the scene at the checkpoint, from the view with the largest weight."""
    weighted = views(pictures, weights=[0.5, 0.5, 0.9, 0.5, 0.5, 0.5])
    with_previews = run(weighted, tmp_path / "a")
    shown = read_rgb(tmp_path / "a" / PREVIEW)
    state = load_state(tmp_path / "a" / "state.safetensors", SilentReporter())
    assert state is not None
    kept = Gaussians(**{name: state[f"parameter.{name}"] for name in start().gaussians.tensors()})
    expected = render(kept, weighted[2].camera, background=start().background).image
    assert 20 < shown.mean() < 235
    np.testing.assert_array_equal(shown, to_uint8(expected.detach().numpy()))

    monkeypatch.setattr(Trainer, "preview", lambda trainer: torch.zeros(2, 2, 3))
    assert_same(with_previews, run(weighted, tmp_path / "b"))


def test_slow_checkpoints_become_rare(
    pictures: list[np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With steps of 0.5 s and checkpoints of 1 s, 5 % of the time allow one checkpoint in about 40 steps."""
    clock, saved = [0.0], []
    step = Trainer.step

    def slow_step(trainer: Trainer) -> None:
        clock[0] += 0.5
        step(trainer)

    def slow_save(path: Path, state: dict[str, Any]) -> None:
        clock[0] += 1.0
        saved.append(int(state["step"]))

    monkeypatch.setattr(training_module.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(training_module, "save_state", slow_save)
    monkeypatch.setattr(Trainer, "step", slow_step)
    run(pictures, tmp_path, CONFIG.model_copy(update={"steps": 100, "checkpoint_interval": 10}))
    assert saved == [10, 50, 90]


def test_relocation_does_not_hide_nan(
    pictures: list[np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def damage(trainer: Trainer) -> None:
        trainer.scene.gaussians.logit_opacities[3] = math.nan

    poison(monkeypatch, 14, damage)  # a refinement at step 15 would treat it as dead, and replace it
    with pytest.raises(StageError, match=r"logit_opacities is not finite in 1 of .* at step 15"):
        run(pictures, tmp_path, CONFIG.model_copy(update={"checkpoint_interval": 50}))


def test_infinite_exposure_is_not_saved(
    pictures: list[np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def damage(trainer: Trainer) -> None:
        formation: Any = trainer._formation
        formation._affines.affines[2, 0, 3] = math.inf

    poison(monkeypatch, 14, damage)
    with pytest.raises(StageError, match="exposure is not finite at step 14"):
        run(pictures, tmp_path, formation=affines())
    saved = load_state(tmp_path / "state.safetensors", SilentReporter())
    assert saved is not None
    assert int(saved["step"]) == 7


def test_a_scene_that_is_not_finite_is_refused(pictures: list[np.ndarray], tmp_path: Path) -> None:
    scene = start(sh_degree=1)
    scene.gaussians.rotations[[5, 7], 1] = math.nan
    with pytest.raises(InputError, match="rotations is not finite in 2 of 60 Gaussians"):
        run(pictures, tmp_path, scene=scene)


def test_exposure_is_learned_and_centred(pictures: list[np.ndarray], tmp_path: Path) -> None:
    darker = [*pictures[:3], *((picture * 0.8).astype(np.uint8) for picture in pictures[3:])]
    weights = [1.0, 0.9, 0.8, 0.9, 0.5, 0.12]
    config = CONFIG.model_copy(update={"steps": 300, "densify": "off", "lr_sh": 1e-3})
    formation = affines(weights, rate=3e-3)
    trained = run(
        views(darker, weights=weights), tmp_path, config, scene=Scene(gaussians()), formation=formation
    )
    exposure = formation.exposure
    assert exposure is not None
    assert exposure.enabled
    settled = centred(exposure.affines, np.array(weights))
    np.testing.assert_allclose(exposure.affines, settled, atol=1e-12)
    grey = [float((exposure.of(frame) @ [0.5, 0.5, 0.5, 1.0]).mean()) for frame in range(6)]
    # The true ratio of the halves is 0.8. The test asserts half of the way; noise would give about 1.
    assert np.mean(grey[3:]) / np.mean(grey[:3]) < 0.9
    bright, dark = (render_formed(trained.scene, views(darker)[i], exposure) for i in (0, 3))
    assert bright.mean() > dark.mean()
