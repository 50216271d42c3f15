"""Creation of the evaluator that the settings name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from cleargs.errors import InputError
from cleargs.plugins import load_plugin
from cleargs.rva.config import EVALUATORS, EvaluatorConfig, QwenConfig
from cleargs.rva.evaluator import Evaluator
from cleargs.types import Device

if TYPE_CHECKING:
    from cleargs.rva.vlm.evaluator import QwenEvaluator


def check_evaluator(config: EvaluatorConfig) -> None:
    """Check that the evaluator of the settings is available. Load no weights.

    Raises InputError if the plugin cannot be loaded, or the server does not answer or lacks the model.
    """
    if config.evaluator == "qwen3-vl":
        _qwen(config.qwen).server.check()
    elif config.evaluator not in EVALUATORS:
        load_plugin("evaluators", config.evaluator)


def make_evaluator(
    config: EvaluatorConfig, *, seed: int = 0, device: Device = "cpu", cache: Path | None = None
) -> Evaluator:
    """Create the evaluator of the settings.

    ``seed`` is for a model on a server or a plugin, ``device`` for a plugin only. ``cache`` is a folder for
    results of single frames; None: no cache.

    Raises:
        InputError: The evaluator is unavailable, for example because the address of its server is invalid.
    """
    if config.evaluator == "statistics":
        from cleargs.rva.statistics import StatisticsEvaluator

        return StatisticsEvaluator(cache)
    if config.evaluator == "qwen3-vl":
        return _qwen(config.qwen, seed, cache)
    maker: Callable[..., Evaluator] = load_plugin("evaluators", config.evaluator)
    return maker(seed=seed, device=device, cache=cache)


def _qwen(config: QwenConfig, seed: int = 0, cache: Path | None = None) -> QwenEvaluator:
    """Create a Qwen3-VL evaluator. Raise InputError if the HTTP client of the server is not installed."""
    try:
        from cleargs.rva.vlm.evaluator import QwenEvaluator
    except ImportError as error:
        raise InputError(
            f"the HTTP client for qwen3-vl cannot be loaded: {error.msg}",
            hint="pip install 'cleargs[server]'",
        ) from error
    return QwenEvaluator(config, seed=seed, cache=cache)
