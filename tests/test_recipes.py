"""The recipes of the paper's method: their settings, and their need for models."""

from __future__ import annotations

import json
from contextlib import nullcontext
from functools import reduce
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest

from cleargs.cli.main import invoke
from cleargs.errors import ConfigError, InputError
from cleargs.media.image import write_rgb
from cleargs.pipeline.config import Config, load_config
from cleargs.pipeline.stages import installed
from cleargs.rva.evaluators import check_evaluator
from cleargs.splat.config import FormationConfig
from cleargs.stages.rva import RvaConfig

METHOD: dict[str, Any] = {
    "rva.enabled": True,
    "rva.weighting": "graded",
    "rva.coverage": True,
    "rva.active_share": 0.0,  # suppressed frames stay suppressed
    "rivr.targets": "all",
    "rivr.harm.control": 0.0,  # every frame is a target, no veto
    "rivr.group": 8,  # along the trajectory
    "rivr.use_observation": True,
    "rivr.undo_motion": False,
    "g0.formation.enabled": False,
    "rivr.keep_raw": False,
    "rivr.candidates": ("fused",),
    "rivr.gate.max_share": 1.0,  # no gate
    "rivr.distil.pseudo_share": "even",
    "rivr.distil.pseudo_weight": 1.0,
    "consolidate.distil.pseudo_share": "even",
    "consolidate.distil.pseudo_weight": 1.0,
}
"""Settings that both recipes must have, whatever the defaults are."""

TABLE: dict[str, Any] = {
    "rva.w_R": (0.30, 0.25, 0.20, 0.15, 0.10),
    "rva.w_B": (0.25, 0.15, 0.20, 0.15, 0.15, 0.10),
    "rva.tau_R": 0.70,
    "rva.tau_B": 0.60,
    "rva.gamma_c": 0.65,
    "rva.gamma_v": 0.35,
    "rva.alpha": 0.45,
    "rva.beta": 0.35,
    "rva.eta": 0.30,
    "rva.lambda_G": 0.35,
    "rva.lambda_R": 0.25,
    "rva.lambda_B": 0.30,
    "rva.lambda_Z": 0.10,
    "rva.reactivated_weight": 0.12,
}
"""The paper's table of RVA parameters."""

PAPER: dict[str, Any] = {
    "rva.evaluator": "qwen3-vl",
    "rivr.expert": "restormer-motion",
    "rivr.primary_scorer": "musiq",
    "rivr.tiebreak_scorer": "clip-iqa",
    "consolidate.scorer": "musiq",
    "g0.steps": 30_000,
    "g0.sh_degree": 3,
    "g0.exposure": "off",
}

OPEN: dict[str, Any] = {
    "rva.evaluator": "statistics",
    "rivr.expert": "nafnet-gopro",
    "rivr.primary_scorer": "clarity-net",
    "rivr.tiebreak_scorer": "naturalness-stats",
    "consolidate.scorer": "clarity-net",
}


def value(config: Config, name: str) -> Any:
    section, *path = name.split(".")
    return reduce(getattr, path, config.sections[section])


@pytest.mark.parametrize(
    ("recipe", "expected"), [("paper", METHOD | TABLE | PAPER), ("paper-open", METHOD | TABLE | OPEN)]
)
def test_the_recipes_are_the_papers_method(recipe: str, expected: dict[str, Any]) -> None:
    config = load_config(installed(), recipe)
    assert {name: value(config, name) for name in expected} == expected


def test_the_paper_has_as_many_gaussians_as_its_field() -> None:
    config = load_config(installed(), "paper")
    assert value(config, "g0.budget") >= max(1_000_000, value(config, "g0.max_budget"))


def test_the_open_row_trains_as_the_default_does() -> None:
    """Frames, trainer and steps are equal, so that the table compares methods.

    Image formation is not a part of the paper's method, and without it cameras have no readout.
    """
    off = {"formation": FormationConfig(enabled=False)}
    default, row = load_config(installed(), "default"), load_config(installed(), "paper-open")
    still = default.sections["ingest"].model_copy(update={"rolling_shutter": False})
    assert row.sections["ingest"] == still
    assert row.sections["g0"] == default.sections["g0"].model_copy(update=off)
    assert value(row, "rivr.rounds") == value(default, "rivr.rounds")
    same = {"pseudo_share": 0.0, "pseudo_weight": 0.0}
    for stage in ("rivr", "consolidate"):
        trainings = [value(config, f"{stage}.distil").model_copy(update=same) for config in (row, default)]
        assert trainings[0] == trainings[1]


@pytest.fixture
def bare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A capture folder; no model is installed and no server listens."""
    monkeypatch.setenv("CLEARGS_MODELS", str(tmp_path / "models"))
    monkeypatch.setenv("CLEARGS_VLM_URL", "http://127.0.0.1:9/v1")  # the port that discards
    monkeypatch.delenv("CLEARGS_STORE", raising=False)
    (tmp_path / "photos").mkdir()
    for k in range(3):
        write_rgb(tmp_path / "photos" / f"{k}.png", np.full((48, 64, 3), 0.1 * k, np.float32))
    return tmp_path


EMBEDDED = {
    "rivr.expert": "embedded",
    "rivr.primary_scorer": "clarity-net",
    "rivr.tiebreak_scorer": "naturalness-stats",
    "consolidate.scorer": "clarity-net",
    "rva.evaluator": "statistics",
}


@pytest.mark.parametrize(
    ("recipe", "kept", "cause", "remedy"),
    [
        (
            "paper",
            "rivr.expert",
            "the model restormer-motion is not installed",
            "tools.convert_models restormer-motion motion_deblurring.pth --accept-licence",
        ),
        (
            "paper",
            "rivr.primary_scorer",
            "the model musiq is not installed",
            "tools.convert_models musiq musiq_koniq_ckpt-e95806b9.pth --accept-licence",
        ),
        (
            "paper",
            "rivr.tiebreak_scorer",
            "the model clip-iqa is not installed",
            "tools.convert_models clip-iqa RN50.pt --accept-licence",
        ),
        ("paper", "consolidate.scorer", "the model musiq is not installed", "tools.convert_models musiq"),
        (
            "paper",
            "rva.evaluator",
            "no server for Qwen/Qwen3-VL-8B-Instruct answers at http://127.0.0.1:9/v1",
            "vllm serve Qwen/Qwen3-VL-8B-Instruct",
        ),
        (
            "paper-open",
            "rivr.expert",
            "the model nafnet-gopro is not installed",
            "tools.convert_models nafnet-gopro",
        ),
        (
            "default",
            "rivr.primary_scorer=clarity",
            "there is no scorer 'clarity'",
            "did you mean clarity-net?",
        ),
        ("default", "rivr.expert=none.onnx", "none.onnx", "check the path"),
    ],
)
def test_a_missing_model_is_an_error_before_any_work(
    bare: Path, capsys: pytest.CaptureFixture[str], recipe: str, kept: str, cause: str, remedy: str
) -> None:
    """Only one model is missing. The others are those of ClearGS."""
    name, _, _ = kept.partition("=")
    settings = [f"{other}={model}" for other, model in EMBEDDED.items() if other != name]
    settings += [kept] if "=" in kept else []
    arguments = ["run", str(bare / "photos"), "-o", str(bare / "run"), "--workflow", recipe]
    code = invoke([*arguments, *(word for setting in settings for word in ("--set", setting))], installed())
    read, *lines = capsys.readouterr().err.strip().splitlines()
    assert code == 2
    assert read.startswith("read: 3 photographs")
    assert len(lines) == 2 and cause in lines[0] and remedy in lines[1]
    assert not (bare / "run" / "ingest").exists()


def test_a_damaged_model_is_an_error_before_any_work(bare: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (bare / "models").mkdir()
    (bare / "models" / "nafnet-gopro.onnx").write_bytes(b"cut off")
    arguments = ["run", str(bare / "photos"), "-o", str(bare / "run"), "--workflow", "paper-open"]
    assert invoke(arguments, installed()) == 2
    assert "nafnet-gopro.onnx is damaged" in capsys.readouterr().err
    assert not (bare / "run" / "ingest").exists()


@pytest.mark.parametrize("share", ["2", "odd"])
def test_a_share_is_a_number_or_even(share: str) -> None:
    with pytest.raises(ConfigError, match=r"^rivr\.distil\.pseudo_share = .* cannot be used"):
        load_config(installed(), "default", [f"rivr.distil.pseudo_share={share}"])


@pytest.mark.parametrize(
    ("status", "body", "cause"),
    [
        (200, {"data": [{"id": "Qwen/Qwen3-VL-8B-Instruct"}]}, None),
        (200, {"data": [{"id": "llama"}]}, "has no model Qwen/Qwen3-VL-8B-Instruct; it has llama"),
        (200, {"data": []}, None),  # it lists no model, so the first frame decides
        (200, "models", None),
        (404, {}, None),
        (401, {}, "refuses the key"),
    ],
)
def test_the_server_must_have_the_model(status: int, body: Any, cause: str | None) -> None:
    class Models(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            assert self.path == "/v1/models"
            self.send_response(status)
            self.end_headers()
            self.wfile.write(json.dumps(body).encode())

        def log_message(self, *_: object) -> None: ...

    with HTTPServer(("127.0.0.1", 0), Models) as server:
        thread = Thread(target=server.handle_request, daemon=True)
        thread.start()
        address = f"http://127.0.0.1:{server.server_port}/v1"
        config = load_config(installed(), "paper", [f"rva.qwen.base_url={address}"]).sections["rva"]
        assert isinstance(config, RvaConfig)
        with pytest.raises(InputError, match=cause) if cause else nullcontext():
            check_evaluator(config)
        thread.join()


def test_a_draft_limits_the_capture_and_trains_g0_to_its_end() -> None:
    """The user's settings are kept for a later run of another quality."""
    config = load_config(installed(), overrides=["g0.quality=draft", "ingest.max_frames=200"])
    asked: Any = config.sections
    used: Any = config.effective
    assert (asked["ingest"].max_frames, asked["ingest"].max_size) == (200, 960)
    assert (used["ingest"].max_frames, used["ingest"].max_size) == (60, 640)
    assert asked["g0"].end < 1.0 and used["g0"].end == 1.0
    assert (asked["rivr"].rounds, used["rivr"].rounds) == (2, 0)
    assert (
        load_config(installed(), "draft").effective
        == load_config(installed(), overrides=["g0.quality=draft"]).effective
    )
    smaller: Any = load_config(installed(), "smoke", ["g0.quality=draft"]).effective
    assert (smaller["ingest"].max_frames, smaller["ingest"].max_size) == (24, 480)


@pytest.mark.parametrize("quality", ["standard", "high"])
def test_other_qualities_share_their_ingest(quality: str) -> None:
    config = load_config(installed(), overrides=[f"g0.quality={quality}"])
    assert config.effective == config.sections


@pytest.mark.parametrize("recipe", ["paper", "paper-open", "smoke"])
def test_these_recipes_try_every_frame(recipe: str) -> None:
    sections: Any = load_config(installed(), recipe).sections
    assert sections["rivr"].targets == "all"
