"""The evaluator that the settings name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from cleargs.errors import InputError
from cleargs.plugins import load_part
from cleargs.rva.config import EVALUATORS, EvaluatorConfig, QwenConfig
from cleargs.rva.evaluator import Evaluator

if TYPE_CHECKING:
    from cleargs.rva.vlm.evaluator import QwenEvaluator

Device = Literal["cpu", "cuda"]


def check_evaluator(config: EvaluatorConfig) -> None:
    """Raise InputError when the model of the evaluator that the settings name cannot be had: nobody answers
    at the server's address, the server has no such model, or the folder holds none that can be loaded.
    """
    if config.evaluator == "qwen3-vl":
        _qwen(config.qwen).check()
    elif config.evaluator not in EVALUATORS:
        load_part("evaluators", config.evaluator)


def make_evaluator(
    config: EvaluatorConfig, *, seed: int = 0, device: Device = "cpu", cache: Path | None = None
) -> Evaluator:
    """The evaluator that the settings name: what another package brings is called with ``seed``, ``device``
    and ``cache``.

    ``cache`` is a folder in which the evaluator keeps what it found out about single frames.
    Raises InputError when the evaluator cannot be had: a bad address or key of its server, say.
    """
    if config.evaluator == "statistics":
        from cleargs.rva.statistics import StatisticsEvaluator

        return StatisticsEvaluator(cache)
    if config.evaluator == "qwen3-vl":
        return _qwen(config.qwen, seed, device, cache)
    maker: Callable[..., Evaluator] = load_part("evaluators", config.evaluator)
    return maker(seed=seed, device=device, cache=cache)


def _qwen(
    config: QwenConfig, seed: int = 0, device: Device = "cpu", cache: Path | None = None
) -> QwenEvaluator:
    """Raises InputError where the HTTP client of the server is not installed."""
    if config.model_dir:
        from cleargs.rva.vlm.local import QwenFolder  # loads torch

        return QwenFolder(config, device=device, cache=cache)
    try:
        from cleargs.rva.vlm.server import QwenServer
    except ImportError as error:
        raise InputError(
            f"the client of a qwen3-vl server cannot be loaded: {error.msg}",
            hint="pip install 'cleargs[server]'",
        ) from error
    return QwenServer(config, seed=seed, cache=cache)
