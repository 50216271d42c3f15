"""Plugins: the package of the examples is found by name, and its version enters the keys."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch

import cleargs as cg
from cleargs.cli.main import explanation
from cleargs.errors import ConfigError, InputError, StageError, StoreError
from cleargs.models.expert import load_expert
from cleargs.models.scorer import load_scorer
from cleargs.pipeline.config import load_config
from cleargs.pipeline.keys import plugin_versions
from cleargs.pipeline.stages import installed
from cleargs.plugins import plugins
from cleargs.progress import SilentReporter
from cleargs.rivr.candidates import Materials, candidate, made_image
from cleargs.rva.evaluator import EvaluatedFrame, evaluated
from cleargs.splat.camera import Camera
from cleargs.splat.config import TrainConfig
from cleargs.splat.formation import Formation
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.scene import Scene
from cleargs.splat.trainer import Trainer
from cleargs.splat.training import run as run_training
from cleargs.splat.views import TrainingView

PARTS = Path(__file__).parents[1] / "examples" / "parts"


def install(folder: Path, version: str = "1.0") -> None:
    """Write the metadata that `pip install examples/parts` would write, into ``folder``."""
    project = tomllib.loads((PARTS / "pyproject.toml").read_text())["project"]
    information = folder / "cleargs_parts.dist-info"
    information.mkdir(exist_ok=True)
    (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: cleargs-parts\nVersion: {version}\n")
    lines = []
    for group, entries in project["entry-points"].items():
        lines += [f"[{group}]", *(f"{name} = {value}" for name, value in entries.items()), ""]
    (information / "entry_points.txt").write_text("\n".join(lines))


@pytest.fixture
def parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The package of the examples, installed for one test."""
    folder = tmp_path / "site-packages"
    folder.mkdir()
    install(folder)
    for path in (folder, PARTS):
        monkeypatch.syspath_prepend(str(path))
    return folder


@pytest.fixture
def picture() -> np.ndarray:
    return np.random.default_rng(0).random((48, 64, 3), dtype=np.float32)


def test_nothing_is_imported_before_it_is_named(parts: Path) -> None:
    for name in [name for name in sys.modules if name.startswith("cleargs_parts")]:
        del sys.modules[name]
    assert list(plugins("evaluators")) == ["contrast"]
    config = load_config(installed(), "default", ["rva.evaluator=contrast"])
    assert config.sections["rva"].evaluator == "contrast"
    assert not any(name.startswith("cleargs_parts") for name in sys.modules)


@pytest.mark.parametrize(
    ("setting", "wrong", "near"),
    [("rva.evaluator", "kontrast", "contrast"), ("ingest.layout", "listet", "listed")],
)
def test_an_unknown_name_is_refused_with_the_nearest(
    setting: str, wrong: str, near: str, parts: Path
) -> None:
    with pytest.raises(ConfigError, match=wrong) as caught:
        load_config(installed(), "default", [f"{setting}={wrong}"])
    assert caught.value.hint == f"did you mean {near}?"


def test_without_the_package_its_names_are_unknown() -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(installed(), "default", ["rva.evaluator=contrast"])
    assert "statistics" in caught.value.hint
    with pytest.raises(InputError, match="there is no scorer 'gradient'"):
        load_scorer("gradient")
    with pytest.raises(InputError, match="there is no expert 'unsharp'"):
        load_expert("unsharp")


def test_the_version_of_the_package_is_in_the_key(parts: Path) -> None:
    overrides = ["rva.evaluator=contrast", "rivr.tiebreak_scorer=gradient"]
    sections = load_config(installed(), "default", overrides).sections
    assert plugin_versions(sections["g0"]) == {}
    assert plugin_versions(sections["rva"]) == {"cleargs-parts for evaluator=contrast": "1.0"}
    assert plugin_versions(sections["rivr"]) == {"cleargs-parts for tiebreak_scorer=gradient": "1.0"}
    install(parts, "1.1")
    assert plugin_versions(sections["rva"]) == {"cleargs-parts for evaluator=contrast": "1.1"}
    for stage in ("rivr", "consolidate"):  # a plugin has no file outside the store
        roles = installed().load(stage).externals(sections[stage], Path())
        assert "tie-break scorer" not in roles and roles


def test_a_broken_plugin_is_an_error_with_a_hint(parts: Path) -> None:
    entries = parts / "cleargs_parts.dist-info" / "entry_points.txt"
    entries.write_text("[cleargs.experts]\nunsharp = cleargs_parts.nowhere:Expert\n")
    with pytest.raises(InputError, match=r"unsharp of cleargs-parts 1\.0 cannot be loaded") as caught:
        load_expert("unsharp")
    assert "uninstall cleargs-parts" in caught.value.hint


def test_evaluator(parts: Path, tmp_path: Path, picture: np.ndarray) -> None:
    from cleargs.media.image import write_rgb

    flat = np.full_like(picture, 0.5)
    for name, image in (("a.png", picture), ("b.png", flat)):
        write_rgb(tmp_path / name, image)
    table = cg.score_frames([tmp_path / "a.png", tmp_path / "b.png"], evaluator="contrast")
    assert table["r_sharpness"].to_pylist() == [1.0, 0.0] and table["B"].to_pylist()[0] == 0.0
    with pytest.raises(ConfigError, match="contrasts"):
        cg.score_frames([], evaluator="contrasts")


@pytest.mark.parametrize("cues", [np.zeros((1, 11)), np.zeros((2, 10)), np.full((2, 11), 1.5)])
def test_an_evaluator_that_returns_no_cues_is_named(cues: np.ndarray) -> None:
    """Too few rows ended in "operands could not be broadcast together", and the request to report it."""
    wrong: Any = SimpleNamespace(name="contrast", version=1, evaluate=lambda views, **options: cues)
    views = [EvaluatedFrame(number, Path("x.png")) for number in range(2)]
    with pytest.raises(StageError, match="the evaluator contrast returned no cues"):
        evaluated(wrong, views, threads=1, reporter=SilentReporter())


def test_a_missing_frame_is_an_error_with_its_name(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"gone\.png"):
        cg.score_frames([tmp_path / "gone.png"])


def test_expert_and_scorer(parts: Path, picture: np.ndarray) -> None:
    restored = cg.restore(picture, expert="unsharp")
    assert restored.shape == picture.shape and np.abs(restored - picture).mean() > 0.01
    assert 0.0 < cg.score(0.5 * picture, scorer="gradient") <= 100.0
    assert cg.score(np.full_like(picture, 0.5), scorer="gradient") == 0.0
    # A plugin cannot replace a part of ClearGS.
    assert load_expert("embedded").name == "embedded"


def test_format(parts: Path, tmp_path: Path) -> None:
    scene = toy()
    cg.save(scene, tmp_path / "room.csv")
    lines = (tmp_path / "room.csv").read_text().splitlines()
    x, y, z = scene.gaussians.means[0].tolist()
    assert lines[0] == "x,y,z" and len(lines) == 1 + scene.gaussians.num
    assert [float(value) for value in lines[1].split(",")] == pytest.approx([x, -y, -z], rel=1e-5)
    with pytest.raises(InputError, match="not a known scene format") as caught:
        cg.save(scene, tmp_path / "room.xyz")
    assert ".csv" in caught.value.hint and ".ply" in caught.value.hint


def test_candidate(parts: Path) -> None:
    config = load_config(installed(), "default", ['rivr.candidates=["fused", "mean"]']).sections["rivr"]
    assert config.candidates == ("fused", "mean")
    assert plugin_versions(config) == {"cleargs-parts for candidates=mean": "1.0"}
    render, restored = np.zeros((4, 4, 3), np.float32), np.ones((4, 4, 3), np.float32)
    made = candidate("mean").make(Materials(render, restored, render, 2.0))
    assert made.dtype == np.float32 and (made == 0.5).all()
    with pytest.raises(ConfigError, match="candidates") as caught:
        load_config(installed(), "default", ['rivr.candidates=["fuse"]'])
    assert caught.value.hint == "did you mean fused?"


def test_faults_of_a_plugin_name_it(parts: Path) -> None:
    """Once: "unexpected ValueError: operands could not be broadcast", and a request to report it."""
    image = np.zeros((4, 6, 3), np.float32)
    for wrong in (image[1:], image * np.nan):
        with pytest.raises(StageError, match="the expert mine made an image of"):
            made_image(wrong, image, "the expert mine")
    assert made_image(image, image, "the expert mine") is image
    information = parts / "cleargs_parts.dist-info/entry_points.txt"
    information.write_text(information.read_text().replace("candidate:MEAN", "candidate:make"))
    with pytest.raises(InputError, match="mean is not a candidate"):
        candidate("mean")
    try:
        load_expert("unsharp").restore(cast(Any, "no image"))
    except Exception as error:
        code, cause, remedy = explanation(error)
    assert code == 1 and cause.startswith("the plugin of cleargs-parts 1.0 failed: ") and "repair" in remedy


def test_densifier(parts: Path, tmp_path: Path) -> None:
    """The strategy removes the transparent half of the scene; the training continues with the other half."""
    config = TrainConfig(steps=8, densify="prune", refine_every=0.5, lr_opacities=0.0, coarse_share=0.0)
    assert plugin_versions(config) == {"cleargs-parts for densify=prune": "1.0"}
    scene = toy()
    scene.gaussians.logit_opacities[::2] = -9.0
    camera = Camera(48, 32, 40.0, 40.0, 24.0, 16.0, np.eye(4))
    image = np.full((32, 48, 3), 128, np.uint8)
    view = TrainingView(0, camera, 1.0, "real", lambda: (image, None))
    trainer = Trainer(scene, [view], config, seed=(0,))
    trained = run_training(trainer, checkpoint=tmp_path / "c", reporter=SilentReporter())
    assert trained.scene.gaussians.num == scene.gaussians.num // 2
    assert len(trained.rows) == 8


def toy(count: int = 30) -> Scene:
    rng = np.random.default_rng(5)
    return Scene(
        Gaussians(
            means=torch.from_numpy(rng.uniform(-0.4, 0.4, (count, 3)).astype(np.float32)),
            log_scales=torch.full((count, 3), -2.5),
            rotations=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
            logit_opacities=torch.full((count,), 2.0),
            sh=torch.from_numpy(rng.uniform(-1.0, 1.0, (count, 1, 3)).astype(np.float32)),
        )
    )


def toy_views(scene: Scene, dim: float = 0.0) -> list[TrainingView]:
    """Three views of ``scene``, ``dim`` darker in the corners."""
    made = []
    for number in range(3):
        pose = np.eye(4)
        pose[:3, 3] = (0.1 * number, 0.0, 1.0)
        camera = Camera(32, 24, 30.0, 30.0, 16.0, 12.0, pose)
        image = cg.render_view(scene, camera).image.detach().clamp(0.0, 1.0).numpy()
        y, x = np.linspace(-1, 1, 24)[:, None], np.linspace(-1, 1, 32)[None, :]
        pixels = (image * (1.0 - dim * ((x * x + y * y) / 2))[..., None]).astype(np.float32)
        made.append(TrainingView(number, camera, 1.0, "real", lambda pixels=pixels: (pixels, None)))
    return made


def test_formation(parts: Path) -> None:
    """The training fits the strength of the vignette in the example."""
    from cleargs_parts.formation import Vignette

    scene, vignette = toy(), Vignette(rate=0.5)
    model: Formation = vignette
    config = TrainConfig(steps=60, densify="off", lr_means=0.0, lr_sh=0.0, lr_opacities=0.0, coarse_share=0.0)
    config = config.model_copy(update={"background": (0.0, 0.0, 0.0)})  # the blobs leave gaps
    trainer = Trainer(scene, toy_views(scene, dim=0.4), config, seed=(0,), formation=model)
    while trainer.done < config.steps:
        trainer.step()
    assert 0.2 < vignette.strength < 0.6  # 0.4 in truth; scales and rotations go on learning
    assert "formation.strength" in trainer.state()


def test_layout(parts: Path, tmp_path: Path, picture: np.ndarray) -> None:
    from cleargs.capture.sources import open_capture
    from cleargs.media.image import write_rgb

    for name in ("b.png", "a.png", "d.png", "c.png"):
        write_rgb(tmp_path / name, picture)
    sections = load_config(installed(), "default", ["ingest.layout=listed"]).sections
    ingest = sections["ingest"]
    with pytest.raises(InputError, match=r"no list\.txt"):
        open_capture(tmp_path, ingest)
    (tmp_path / "list.txt").write_text("c.png\nb.png\na.png\n")
    assert [frame.name for frame in open_capture(tmp_path, ingest).frames] == ["c.png", "b.png", "a.png"]
    roles = installed().load("ingest").externals(ingest, tmp_path)
    assert set(roles) == {"list", "images"} and set(roles["images"]) == {"a.png", "b.png", "c.png"}
    assert plugin_versions(ingest) == {"cleargs-parts for layout=listed": "1.0"}
    (tmp_path / "list.txt").write_text("a.png")
    with pytest.raises(InputError, match="at least 3"):
        open_capture(tmp_path, ingest)
