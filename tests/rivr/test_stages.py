"""RIVR and the consolidation from end to end, on a tiny capture with a stand-in expert and scorers."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import pkgutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from OpenImageIO import HALF, ImageBuf
from tiny_capture import (
    HEIGHT,
    MASKED_FRAME,
    ROLES,
    WIDTH,
    Capture,
    Contrast,
    Darkness,
    Sharpen,
    orbit,
    tiny_consolidate,
    tiny_g0,
    tiny_rivr,
    tried_rows,
    write_capture,
)

from cleargs.formation.capture import CaptureFormation
from cleargs.formation.frame import FrameFormation
from cleargs.formation.motion import FrameMotion
from cleargs.formation.movement import write_movement
from cleargs.formation.table import write_formation
from cleargs.media.exr import from_layer, read_exr
from cleargs.models import expert as expert_module
from cleargs.models import scorer as scorer_module
from cleargs.progress import SilentReporter
from cleargs.rivr import rounds
from cleargs.rivr.candidates import decide, fuse
from cleargs.rivr.tables import (
    REPAIRS,
    SELECTION,
    Selection,
    kept_raw,
    latest_accepted,
    read_selection,
    repaired_share,
    write_selection,
)
from cleargs.rivr.targets import load_supervision
from cleargs.scene import training as scene_training
from cleargs.scene import viewer
from cleargs.scene.dust import Dusted, without_dust
from cleargs.scene.measure import ViewPsnr, evaluate_views
from cleargs.scene.viewer import SceneViewer
from cleargs.splat.config import FormationConfig
from cleargs.splat.scene import Scene
from cleargs.splat.training import Trained
from cleargs.splat.views import TrainingView
from cleargs.stages import consolidate, rivr

HELD_BACK = 3
"""The middle one of the strong frames 0, 3 and 5."""
MOVING_FRAME = 4
"""In its left 20 columns something moves, in one test."""
TARGETS = [k for k in range(len(ROLES)) if k != HELD_BACK]


@pytest.fixture
def expert() -> Sharpen:
    return Sharpen()


@pytest.fixture
def capture(tmp_path: Path, expert: Sharpen, monkeypatch: pytest.MonkeyPatch) -> Capture:
    """The tiny capture, with small stand-ins for the expert and the scorers."""
    return make_capture(tmp_path, expert, monkeypatch)


def make_capture(root: Path, expert: Sharpen, monkeypatch: pytest.MonkeyPatch) -> Capture:
    scorers = {"clarity-net": Contrast(), "naturalness-stats": Darkness()}
    monkeypatch.setattr(expert_module, "load_expert", lambda spec, device: expert)
    monkeypatch.setattr(scorer_module, "load_scorer", lambda name, device: scorers[name])
    write_capture(root)
    return Capture(root)


def digests(folder: Path) -> dict[str, str]:
    """Relative path -> digest of every file."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def same_scene(a: Path, b: Path) -> bool:
    return all(
        (a / name).read_bytes() == (b / name).read_bytes()
        for name in (
            "scene.ply",
            "exposure.parquet",
            "formation.parquet",
            "movement.parquet",
            "state.safetensors",
        )
    )


def test_every_round_repairs_every_target(capture: Capture, expert: Sharpen) -> None:
    context = capture.context("rivr", tiny_rivr())
    result = rivr.run(context)

    assert expert.calls == len(TARGETS)  # once a frame, not once a round
    assert pq.read_schema(context.out / "selection.parquet").names == SELECTION.names
    rows = tried_rows(context)
    assert [(row.round, row.frame_id) for row in rows] == [(n, k) for n in (1, 2) for k in TARGETS]
    assert all(row.accepted for row in rows)
    assert {row.primary_metric for row in rows} == {"contrast"}
    for row in rows:
        exr = read_exr(context.out / row.exr, "cleargs:")
        assert list(exr.attributes) == ["cleargs:row"]
        assert Selection(**json.loads(exr.attributes["cleargs:row"])) == row
        plain = ImageBuf(str(context.out / row.exr)).get_pixels(HALF)[..., :3]
        np.testing.assert_array_equal(plain, exr.layers[row.chosen])  # the layer that ordinary programs show
        assert row.primary.keys() == row.tiebreak.keys() == {"render", "restored", "fused"}
        images = {name: from_layer(layer) for name, layer in exr.layers.items()}
        fused = fuse(images["render"], images["restored"], 2.0)
        np.testing.assert_allclose(images["fused"], fused, atol=1 / 4096)  # half floats
    assert not same_scene(context.out, capture.root / "g0")
    assert set(rivr.OUTPUTS) <= {path.name for path in context.out.iterdir()}
    log = pq.read_table(context.out / "train.parquet").to_pydict()
    assert set(log["round"]) == {1, 2}
    drawn = set(zip(log["frame_id"], log["kind"], strict=True))
    assert (HELD_BACK, "pseudo") not in drawn
    # The held-back frame goes on supervising as it did for G0.
    assert {frame_id for frame_id, kind in drawn if kind == "real"} <= {0, 2, HELD_BACK, 4, 5, 6}
    summary = result.summary
    assert summary["control"]["frames"] == [HELD_BACK]
    assert sum(summary["rounds"][0]["chosen"].values()) == len(TARGETS)
    assert summary["published"] == "distilled scene"


def test_later_rounds_render_the_distilled_scene(capture: Capture) -> None:
    context = capture.context("rivr", tiny_rivr())
    rivr.run(context)
    first, second = (read_exr(context.out / f"round_0{n}/000001.exr").layers for n in (1, 2))
    np.testing.assert_array_equal(first["restored"], second["restored"])
    np.testing.assert_array_equal(first["observed"], second["observed"])
    assert (first["render"] != second["render"]).any()


def test_without_the_observation_the_expert_restores_the_render(capture: Capture, expert: Sharpen) -> None:
    context = capture.context("rivr", tiny_rivr(use_observation=False))
    rivr.run(context)
    assert expert.calls == 2 * len(TARGETS)
    layers = read_exr(context.out / "round_02/000001.exr").layers
    assert set(layers) == {"render", "restored", "fused", "observed"}
    # The expert saw the float32 render, the EXR holds its half: a few half steps of slack for the sharpening.
    np.testing.assert_allclose(
        from_layer(layers["restored"]), expert.restore(from_layer(layers["render"])), atol=4e-3
    )


def test_the_expert_sees_the_frame_without_its_motion(capture: Capture, expert: Sharpen) -> None:
    capture.use_good_scene()
    context = capture.context("rivr", tiny_rivr(undo_motion=True))
    rivr.run(context)
    rows = tried_rows(context)
    sharp = {row.frame_id for row in rows if row.restored_from == "observed"}
    # Every round renders, and so deblurs, again; a frame that nothing explains is restored once as it is.
    assert expert.calls == sum(row.restored_from == "deblurred" for row in rows) + len(sharp)
    blur = dict.fromkeys(((n, k) for n in (1, 2) for k in TARGETS), 0.0)
    for row in rows:
        exr = read_exr(context.out / row.exr, "cleargs:")
        if row.restored_from == "observed":
            assert row.blur_px is None
            continue
        assert row.blur_px is not None
        blur[row.round, row.frame_id] = row.blur_px
        # The expert saw float32, the EXR holds halves: a few half steps of slack for the sharpening.
        deblurred = from_layer(exr.layers["deblurred"])
        np.testing.assert_allclose(from_layer(exr.layers["restored"]), expert.restore(deblurred), atol=4e-3)
    # Frames of low quality are means over seven pixels along the rows.
    assert min(blur[1, k] for k in TARGETS if ROLES[k] != "strong") > 3.0
    assert max(blur[1, k] for k in TARGETS if ROLES[k] == "strong") < 1.0  # measured: 0.6


def test_without_fusion_there_are_two_candidates(capture: Capture) -> None:
    context = capture.context("rivr", tiny_rivr(candidates=(), rounds=1))
    rivr.run(context)
    rows = tried_rows(context)
    assert {row.chosen for row in rows} <= {"render", "restored"}
    assert all(row.primary.keys() == row.tiebreak.keys() == {"render", "restored"} for row in rows)
    assert set(read_exr(context.out / rows[0].exr).layers) == {"render", "restored", "observed"}


class Faithful:
    """An expert that leaves images as they are, except for a little grain."""

    name = "faithful"
    digest = "none"

    def restore(self, image: np.ndarray, **_: Any) -> np.ndarray:
        grain = np.random.default_rng(0).normal(0, 1e-3, image.shape).astype(np.float32)
        return np.clip(image + grain, 0, 1)


def keeping(**changes: Any) -> Any:
    """Return the default settings: motion undone, no fusion, frame images kept.

    The stand-in scorers have no calibrated scale. The margin leaves the choice to them only where they differ
    much.
    """
    return tiny_rivr(undo_motion=True, candidates=(), keep_raw=True, margin=20.0, **changes)


PLAIN = tiny_g0(formation={"enabled": False}, background=(0.0, 0.0, 0.0))
"""The toy scene has gaps that its frames show in black: over changing colours, training would fill them."""


def test_a_frame_that_formation_explains_goes_on_teaching_by_itself(
    capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It keeps its frame image, the EXR shows how it is explained, and no repair of it is drawn."""
    monkeypatch.setattr(expert_module, "load_expert", lambda spec, device: Faithful())
    capture.use_good_scene()
    blurred = 2
    views = [
        TrainingView(k, orbit(k), 1.0 if ROLES[k] == "strong" else 0.5, "real", lambda: (None, None))
        for k in TARGETS
    ]
    motion = FrameMotion(blur=np.array([0, 0, 0, 0, 6.0, 0]), median_depth=2.0)
    known = {blurred: FrameFormation(blurred, motion, "blur", 0.001, 0.01, 6.0, displacement_px=3.0)}
    weights = {view.frame_id: view.weight for view in views}
    formation = CaptureFormation(views, FormationConfig(), known=known)
    write_formation(capture.root / "g0" / "formation.parquet", formation, weights)
    context = capture.context("rivr", tiny_rivr(rounds=1, keep_raw=True))
    rivr.run(context)
    rows = {row.frame_id: row for row in tried_rows(context)}
    assert (rows[blurred].chosen, rows[blurred].accepted) == ("observed", False)
    assert rows[blurred].reason == "explained: blur 6.0 px"
    layers = read_exr(context.out / rows[blurred].exr).layers
    seen, explained, render = (from_layer(layers[name]) for name in ("observed", "explained", "render"))
    # The frame is a mean over seven pixels along the rows, the render sharp; both are a little off in colour.
    assert np.abs(explained - seen).mean() < 0.8 * np.abs(render - seen).mean()
    log = pq.read_table(context.out / "train.parquet").to_pydict()
    assert (blurred, "pseudo") not in set(zip(log["frame_id"], log["kind"], strict=True))


def test_layers_of_a_frame_without_an_exr_are_computed(
    capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From what the training has found: nothing is estimated again."""
    capture.use_good_scene()
    motion = FrameMotion(blur=np.array([0, 0, 0, 0, 6.0, 0]), median_depth=2.0)
    found = FrameFormation(2, motion, "blur", 0.001, 0.01, 6.0, displacement_px=3.0, steps=30)
    supervision = load_supervision(capture.root / "ingest", capture.root / "rva", 0.125)
    view = supervision.views[2]
    formation = CaptureFormation([view], FormationConfig(), known={2: found})
    write_formation(capture.root / "g0" / "formation.parquet", formation, {2: view.weight})
    scene = SceneViewer(capture.root / "g0")
    monkeypatch.setattr(viewer, "fit_motion", None)
    undone = scene.deblur(view)
    assert undone is not None and undone.formation.blur_px == 6.0
    whole, half = scene.formed_layers(view), scene.formed_layers(view, 0.5)
    np.testing.assert_array_equal(whole["deblurred"], undone.image)
    explained = scene.explained(view)
    assert explained is not None
    np.testing.assert_array_equal(whole["explained"], explained.image)
    assert {image.shape for image in half.values()} == {(HEIGHT // 2, WIDTH // 2, 3)}
    assert scene.formed_layers(supervision.views[0]) == {}


def test_a_scene_is_compared_with_few_frames(capture: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    compared: list[int] = []

    def recorded(scene: Scene, views: list[TrainingView], *rest: Any, **options: Any) -> list[ViewPsnr]:
        compared.extend(view.frame_id for view in views)
        return evaluate_views(scene, views, *rest, **options)

    monkeypatch.setattr(viewer, "MAX_EVALUATED", 3)
    monkeypatch.setattr(viewer, "evaluate_views", recorded)
    supervision = load_supervision(capture.root / "ingest", capture.root / "rva", 0.125)
    views = [view for _, view in sorted(supervision.views.items())][:7]
    assert SceneViewer(capture.root / "g0").psnr_unseen(views) is not None
    assert compared == [views[0].frame_id, views[3].frame_id, views[6].frame_id]


@pytest.mark.parametrize("densify", [False, True])
def test_dust_is_looked_for_where_gaussians_are_added(
    densify: bool, capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[int] = []

    def counted(trained: Trained, *rest: Any) -> Dusted:
        looked.append(trained.scene.gaussians.num)
        return without_dust(trained, *rest)

    monkeypatch.setattr(scene_training, "without_dust", counted)
    distil = {"steps": 12, "densify": densify}
    rivr.run(capture.context("rivr", tiny_rivr(rounds=1, distil=distil)))
    assert bool(looked) == densify


def test_a_sharp_frame_keeps_its_raw_image(capture: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sharp frames are kept and supervise as frame images alone; blurred ones get repairs."""
    monkeypatch.setattr(expert_module, "load_expert", lambda spec, device: Faithful())
    capture.use_good_scene()
    context = capture.context("rivr", keeping(), g0=PLAIN)
    result = rivr.run(context)
    rows = tried_rows(context)
    kept = {(row.round, row.frame_id) for row in rows if row.chosen == "observed"}
    sharp = {k for k in TARGETS if ROLES[k] == "strong"}
    assert kept == {(n, k) for n in (1, 2) for k in sharp}
    for row in rows:
        assert row.accepted == ((row.round, row.frame_id) not in kept)
        assert (row.reason == "needs no repair") == (row.chosen == "observed")
        assert "observed" in row.primary and "observed" in row.tiebreak
    log = pq.read_table(context.out / "train.parquet").to_pydict()
    drawn = set(zip(log["frame_id"], log["kind"], strict=True))
    assert not {(k, "pseudo") for k in sharp} & drawn
    assert result.summary["rounds"][0]["chosen"]["observed"] == len(sharp)
    assert result.summary["rounds"][0]["refused"] == {}

    second = capture.context("consolidate", tiny_consolidate())
    summary = consolidate.run(second).summary
    assert summary["repairs"] == len(TARGETS) - len(sharp)
    assert summary["chosen"]["observed"] == len(sharp)


def test_where_every_frame_is_kept_the_scene_trains_on_raw_frames(capture: Capture) -> None:
    first = capture.context("rivr", tiny_rivr(rounds=1))
    rivr.run(first)
    rows = tried_rows(first)
    rows = [dataclasses.replace(row, accepted=False, chosen="observed") for row in rows]
    write_selection(first.out / "selection.parquet", rows)
    context = capture.context("consolidate", tiny_consolidate())
    summary = consolidate.run(context).summary
    log = pq.read_table(context.out / "train.parquet").to_pydict()
    assert len(log["kind"]) == 12 and set(log["kind"]) == {"real"}
    assert (summary["repairs"], summary["chosen"]["observed"]) == (0, len(TARGETS))
    assert summary["control"]["frames"] == []  # no repair can have done harm


def test_the_latest_round_decides_whether_a_frame_is_repaired(capture: Capture) -> None:
    """Kept raw after a repair: the repair is taken back; repaired after being kept: the repair counts."""
    context = capture.context("rivr", tiny_rivr())
    rivr.run(context)
    rows = tried_rows(context)
    raw = {(2, 1), (1, 4)}
    rows = [
        dataclasses.replace(row, accepted=False, chosen="observed")
        if (row.round, row.frame_id) in raw
        else row
        for row in rows
    ]
    assert kept_raw(rows) == {1}
    assert {row.frame_id: row.round for row in latest_accepted(rows)} == dict.fromkeys(
        (k for k in TARGETS if k != 1), 2
    )
    assert repaired_share(rows) == (len(TARGETS) - 1) / len(TARGETS)


def test_the_papers_rule_scores_no_raw_frame(capture: Capture) -> None:
    context = capture.context("rivr", tiny_rivr(rounds=1))
    rivr.run(context)
    rows = tried_rows(context)
    assert not any("observed" in row.primary or "observed" in row.tiebreak for row in rows)
    assert "observed" not in {row.chosen for row in rows}
    assert all(row.accepted for row in rows)


@pytest.mark.parametrize("frame", [MASKED_FRAME, MOVING_FRAME])
def test_masked_pixels_and_what_moves_do_not_reach_the_scores(
    capture: Capture, monkeypatch: pytest.MonkeyPatch, expert: Sharpen, frame: int
) -> None:
    """An expert that ruins the masked pixels changes no score; one that ruins the others does."""
    cells = np.zeros((HEIGHT // 2, WIDTH // 2), np.bool_)
    cells[:, :10] = True
    write_movement(capture.root / "g0" / "movement.parquet", {MOVING_FRAME: cells})

    def scores(run: str, ruined: slice) -> Selection:
        def ruin(image: np.ndarray, **_: Any) -> np.ndarray:
            restored = image.copy()
            restored[:, ruined] = np.random.default_rng(0).random(restored[:, ruined].shape)
            return restored

        monkeypatch.setattr(expert, "restore", ruin)
        context = capture.context("rivr", tiny_rivr(rounds=1, candidates=()), run=run)
        rivr.run(context)
        rows = tried_rows(context)
        return next(row for row in rows if row.frame_id == frame)

    untouched, masked, seen = scores("a", slice(0, 0)), scores("b", slice(0, 20)), scores("c", slice(20, 40))
    assert masked.primary["restored"] == untouched.primary["restored"]
    assert seen.primary["restored"] != untouched.primary["restored"]


@pytest.mark.parametrize("stage", ["rivr", "consolidate"])
def test_harm_keeps_the_better_scene(capture: Capture, stage: str) -> None:
    """Rates that wreck the scene: it is not published, but stored next to the one that is."""
    wrecking, strict = tiny_g0(lr_scales=3.0), tiny_rivr(harm={"psnr_margin": 0.5, "score_margin": 100})
    if stage == "rivr":
        context, better = capture.context("rivr", strict, g0=wrecking), capture.root / "g0"
        result = rivr.run(context)
    else:
        first = capture.context("rivr", tiny_rivr(rounds=1))
        rivr.run(first)
        context, better = capture.context(stage, tiny_consolidate(), g0=wrecking, rivr=strict), first.out
        result = consolidate.run(context)
    assert same_scene(context.out, better)
    assert (context.out / "rejected.ply").read_bytes() != (context.out / "scene.ply").read_bytes()
    checked = result.summary["control"]
    assert "PSNR fell" in checked["harm"]
    assert checked["psnr_after"] < checked["psnr_before"] - 0.5


def test_consolidation_takes_the_latest_accepted_repair(capture: Capture) -> None:
    first = capture.context("rivr", tiny_rivr())
    rivr.run(first)
    rows = tried_rows(first)
    refused = {(2, 1), (1, 4), (2, 4)}
    rows = [dataclasses.replace(row, accepted=(row.round, row.frame_id) not in refused) for row in rows]
    write_selection(first.out / "selection.parquet", rows)

    context = capture.context("consolidate", tiny_consolidate())
    result = consolidate.run(context)
    table = pq.read_table(context.out / "repairs.parquet")
    assert table.schema.names == REPAIRS.names
    latest = {row["frame_id"]: row["round"] for row in table.to_pylist()}
    assert latest == {k: 1 if k == 1 else 2 for k in TARGETS if k != 4}
    log = pq.read_table(context.out / "train.parquet").to_pydict()
    pseudo = {k for k, kind in zip(log["frame_id"], log["kind"], strict=True) if kind == "pseudo"}
    assert pseudo <= set(latest)
    assert not same_scene(context.out, first.out)
    assert set(consolidate.OUTPUTS) <= {path.name for path in context.out.iterdir()}
    assert result.summary["repairs"] == len(TARGETS) - 1


def test_without_rounds_the_first_scene_stays(capture: Capture) -> None:
    first = capture.context("rivr", tiny_rivr(rounds=0))
    assert rivr.run(first).summary["published"] == "G0"
    rows = read_selection(first.out / "selection.parquet")
    assert [row.frame_id for row in rows] == list(range(len(ROLES)))
    assert {(row.exr, row.chosen, row.reason) for row in rows} == {
        (None, "observed", "not tried: no repairs are made")
    }
    second = capture.context("consolidate", tiny_consolidate(), rivr=tiny_rivr(rounds=0))
    assert consolidate.run(second).summary == {"repairs": 0, "published": "G0"}
    for context, stage in ((first, rivr), (second, consolidate)):
        assert same_scene(context.out, capture.root / "g0")
        assert set(stage.OUTPUTS) <= {path.name for path in context.out.iterdir()}


def test_a_round_in_which_nothing_is_taken_ends_the_rounds(
    capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its training takes the steps of the rounds that are left, on the frame images."""
    lines: list[str] = []
    monkeypatch.setattr(SilentReporter, "info", lambda reporter, text: lines.append(text))
    monkeypatch.setattr(rounds, "decide", lambda *args, **facts: decide(*args, **facts | {"masked": True}))
    context = capture.context("rivr", tiny_rivr(rounds=3, targets="auto"))
    result = rivr.run(context)
    assert [made["round"] for made in result.summary["rounds"]] == [1]
    log = pq.read_table(context.out / "train.parquet").to_pydict()
    assert len(log["frame_id"]) == 3 * 12 and set(log["kind"]) == {"real"}
    assert any("no candidate is taken" in line for line in lines)
    assert result.summary["control"]["frames"] == []  # no repair can have done harm


def test_consolidation_without_repairs_is_g0_byte_for_byte(capture: Capture) -> None:
    first = capture.context("rivr", tiny_rivr(rounds=1))
    rivr.run(first)
    rows = [dataclasses.replace(row, accepted=False) for row in tried_rows(first)]
    write_selection(first.out / "selection.parquet", rows)

    context = capture.context("consolidate", tiny_consolidate())
    result = consolidate.run(context)
    assert same_scene(context.out, capture.root / "g0")
    assert pq.read_table(context.out / "repairs.parquet").num_rows == 0
    assert pq.read_table(context.out / "train.parquet").num_rows == 0
    assert result.summary["published"] == "G0"
    assert set(consolidate.OUTPUTS) <= {path.name for path in context.out.iterdir()}


class KilledError(Exception):
    """Stands for kill -9."""


def dying(after: int, function: Callable[..., Any]) -> Callable[..., Any]:
    """``function``, until it is called for the ``after``-th time."""
    calls = iter(range(after))

    def call(*args: Any, **kwargs: Any) -> Any:
        if next(calls, None) is None:
            raise KilledError
        return function(*args, **kwargs)

    return call


def run_both(capture: Capture, *, threads: int) -> dict[str, dict[str, str]]:
    """Run both stages; the digests of their files."""
    found = {}
    configs = {rivr: tiny_rivr(), consolidate: tiny_consolidate()}
    for stage, config in configs.items():
        name = stage.__name__.rpartition(".")[2]
        context = capture.context(name, config, threads=threads)
        stage.run(context)
        found[name] = digests(context.out)
    return found


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, str]]:
    """Results of both stages on one thread when nothing disturbs them."""
    with pytest.MonkeyPatch.context() as patch:
        return run_both(make_capture(tmp_path_factory.mktemp("undisturbed"), Sharpen(), patch), threads=1)


@pytest.mark.parametrize(
    ("where", "after"),
    [
        ("cleargs.rivr.rounds.write_exr", 3),  # inside round 1
        ("cleargs.rivr.rounds.write_exr", 10),  # inside round 2
        ("cleargs.splat.trainer.Trainer.step", 8),  # inside the distillation of round 1
        ("cleargs.splat.trainer.Trainer.step", 12),  # after it, before its files
        ("cleargs.splat.trainer.Trainer.step", 20),  # inside the distillation of round 2
        ("cleargs.splat.trainer.Trainer.step", 30),  # inside the consolidation
        ("cleargs.splat.ply.write_ply", 1),  # the last file of round 2
        ("cleargs.scene.folder._copy", 1),  # while publishing
    ],
)
def test_a_killed_run_goes_on_to_the_same_files(
    capture: Capture,
    undisturbed: dict[str, dict[str, str]],
    monkeypatch: pytest.MonkeyPatch,
    where: str,
    after: int,
) -> None:
    with monkeypatch.context() as patch:
        module, _, name = where.rpartition(".")
        patch.setattr(where, dying(after, getattr(pkgutil.resolve_name(module), name)))
        with pytest.raises(KilledError):
            run_both(capture, threads=2)
    assert run_both(capture, threads=2) == undisturbed


def test_a_damaged_exr_is_made_again(capture: Capture, undisturbed: dict[str, dict[str, str]]) -> None:
    """Its frame alone: the expert's cached restoration and the finished trainings are used again."""
    assert run_both(capture, threads=1) == undisturbed
    victim = capture.root / "run" / "rivr" / "round_01" / "000004.exr"
    victim.write_bytes(victim.read_bytes()[:1000])
    context = dataclasses.replace(capture.context("rivr", tiny_rivr()), reporter=(remarks := Remarks()))
    rivr.run(context)
    assert [line.partition(":")[0] for line in remarks.warnings] == ["round_01/000004.exr"]
    assert run_both(capture, threads=1) == undisturbed


def test_exrs_that_no_frame_of_the_round_left_are_not_published(
    capture: Capture, undisturbed: dict[str, dict[str, str]]
) -> None:
    """EXRs of a held-out frame, of a round too many, or under another frame's name."""
    assert run_both(capture, threads=1) == undisturbed
    out = capture.root / "run" / "rivr"
    image = (out / "round_01" / "000004.exr").read_bytes()
    (out / "round_09").mkdir()
    for place in (f"round_01/{HELD_BACK:06d}.exr", "round_01/x.exr", "round_09/000004.exr"):
        (out / place).write_bytes(image)
    for number, frame in ((1, 5), (2, 4)):  # another frame's, and another round's
        (out / f"round_{number:02d}" / f"{frame:06d}.exr").write_bytes(image)
    assert run_both(capture, threads=1) == undisturbed


class Remarks(SilentReporter):
    """A reporter that keeps its warnings."""

    def __init__(self) -> None:
        self.warnings: list[str] = []

    def warn(self, text: str) -> None:
        self.warnings.append(text)
