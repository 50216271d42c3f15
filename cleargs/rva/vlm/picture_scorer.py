"""Who answers the prompt: the protocol that a server and a model in process follow."""

from __future__ import annotations

from typing import Protocol

from cleargs.rva.scores import Floats
from cleargs.rva.vlm.picture import Picture


class UnscoredError(Exception):
    """A frame got no valid scores, for the reason given; other frames may."""


class PictureScorer(Protocol):
    """A vision-language model that scores one picture at a time."""

    @property
    def model(self) -> str:
        """Its name, for the tables."""

    @property
    def identity(self) -> str:
        """Whatever decides its scores beside the picture: scores are kept under it."""

    @property
    def workers(self) -> int:
        """How many pictures it takes at once, each in a thread of its own."""

    def score(self, picture: Picture) -> Floats:  # [11] in [0, 1], as tables.CUE_COLUMNS
        """The cues of one picture.

        Raises UnscoredError where this picture gets none, StageError or InputError where no picture would.
        """

    def stop(self) -> None:
        """Give up what is under way as soon as possible; called from another thread."""
