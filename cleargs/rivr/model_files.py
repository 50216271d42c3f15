"""The model files behind the settings of RIVR: their content enters the keys."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from cleargs.models.scorer import CLARITY


def scorer_path(spec: str) -> Path | None:
    """The ONNX file of a scorer; None for one without weights, whose code the stage's VERSION covers."""
    if spec == CLARITY:
        return Path(str(files("cleargs.models"))) / "weights" / "scorer.onnx"
    return Path(spec) if spec.endswith(".onnx") else None
