"""Who judges the appearance of a frame: the protocol that all evaluators follow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol

from cleargs.plugins import load_part
from cleargs.progress import Reporter
from cleargs.rva.config import EVALUATORS, RvaConfig
from cleargs.rva.scores import Floats

if TYPE_CHECKING:
    from cleargs.rva.vlm.picture_scorer import PictureScorer


@dataclass(frozen=True)
class View:
    """A frame as an evaluator gets it: files, so that nobody has to hold a video in memory."""

    frame_id: int
    image: Path
    mask: Path | None = None
    """8-bit image of the same size; pixels that are 0 in it are ignored."""


class Evaluator(Protocol):
    """Estimates the eleven appearance cues of every frame of a capture."""

    @property
    def name(self) -> str:
        """What the user calls it in ``rva.evaluator``, with the model it asks where there is one."""

    @property
    def version(self) -> int:
        """Raised when equal images get other cues."""

    def evaluate(self, views: Sequence[View], *, threads: int, reporter: Reporter) -> Floats:
        """Cues [n, 11] in [0, 1], columns as `tables.CUE_COLUMNS`, for frames given in trajectory order.

        A row of NaN is a frame that could not be scored; ``reporter`` was told why. Neighbours in ``views``
        are neighbours in the video. Images are read as they are needed: memory does not grow with their
        number. The result does not depend on ``threads``.
        """


def label(evaluator: Evaluator) -> str:
    """How the tables name an evaluator."""
    return f"{evaluator.name}-{evaluator.version}"


def check_evaluator(config: RvaConfig) -> None:
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
    from cleargs.rva.vlm.chat import ChatClient

    ChatClient(config.qwen).check_model()


def make_evaluator(
    config: RvaConfig,
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
    from cleargs.rva.vlm.qwen_evaluator import QwenEvaluator

    if cache is None:
        raise ValueError("qwen3-vl needs a cache folder")
    scorer: PictureScorer
    if config.qwen.model_dir:
        from cleargs.rva.vlm.local import LocalPictureScorer  # loads torch

        scorer = LocalPictureScorer(config.qwen, device=device)
    else:
        from cleargs.rva.vlm.server import ServerPictureScorer

        scorer = ServerPictureScorer(config.qwen, seed=seed)
    return QwenEvaluator(scorer, image_size=config.qwen.image_size, cache=cache)
