"""The evaluator that the settings name."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Literal

from cleargs.errors import InputError
from cleargs.plugins import load_part
from cleargs.rva.config import EVALUATORS, EvaluatorConfig
from cleargs.rva.evaluator import Evaluator

if TYPE_CHECKING:
    from cleargs.rva.vlm.evaluator import PictureScorer


def check_evaluator(config: EvaluatorConfig) -> None:
    """Raise InputError when the model of the evaluator that the settings name cannot be had: nobody answers
    at the server's address, the server has no such model, or the folder holds none that can be loaded."""
    if config.evaluator == "statistics":
        return
    if config.evaluator not in EVALUATORS:
        load_part("evaluators", config.evaluator)
        return
    if config.qwen.model_dir:
        from cleargs.rva.vlm.local import check_folder

        check_folder(Path(config.qwen.model_dir).expanduser().absolute())
        return
    _server().ChatClient(config.qwen).check_model()


def make_evaluator(
    config: EvaluatorConfig,
    *,
    seed: int = 0,
    device: Literal["cpu", "cuda"] = "cpu",
    cache: Path | None = None,
) -> Evaluator:
    """The evaluator that the settings name: what another package brings is called with ``seed``, ``device``
    and ``cache``.

    ``cache`` is a folder in which the evaluator keeps what it found out about single frames; ``qwen3-vl``
    needs one.
    Raises InputError when the evaluator cannot be had: a bad address or key of its server, say.
    """
    if config.evaluator == "statistics":
        from cleargs.rva.statistics import StatisticsEvaluator  # loads cv2: not before it is needed

        return StatisticsEvaluator(cache)
    if config.evaluator not in EVALUATORS:
        maker: Callable[..., Evaluator] = load_part("evaluators", config.evaluator)
        return maker(seed=seed, device=device, cache=cache)
    from cleargs.rva.vlm.evaluator import QwenEvaluator

    if cache is None:
        raise ValueError("qwen3-vl needs a cache folder")
    scorer: PictureScorer
    if config.qwen.model_dir:
        from cleargs.rva.vlm.local import LocalPictureScorer  # loads torch

        scorer = LocalPictureScorer(config.qwen, device=device)
    else:
        scorer = _server().ServerPictureScorer(config.qwen, seed=seed)
    return QwenEvaluator(scorer, image_size=config.qwen.image_size, cache=cache)


def _server() -> ModuleType:
    """`cleargs.rva.vlm.server`. Raises InputError where its HTTP client is not installed."""
    try:
        return import_module("cleargs.rva.vlm.server")
    except ImportError as error:
        raise InputError(
            f"the client of a qwen3-vl server cannot be loaded: {error.msg}",
            hint="pip install 'cleargs[server]'",
        ) from error
