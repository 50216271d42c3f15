"""The image as the model meets it: reduced to a stated size, masked pixels painted over, never enlarged; and
who answers the prompt about it, a server or a model in process."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from cleargs.errors import StoreError
from cleargs.media.image import read_mask, read_rgb
from cleargs.rva.arrays import Floats
from cleargs.rva.evaluator import View

_MASKED = 127  # mid-grey, as the prompt calls it


@dataclass(frozen=True, eq=False)
class Picture:
    """What is shown to a model."""

    rgb: npt.NDArray[np.uint8]  # [h, w, 3] sRGB
    masked: bool
    """Whether parts are painted grey."""

    def data_url(self) -> str:
        """As PNG: a lossy format would add artifacts of its own to those that are judged."""
        _, png = cv2.imencode(".png", cv2.cvtColor(self.rgb, cv2.COLOR_RGB2BGR))
        return f"data:image/png;base64,{base64.b64encode(png.tobytes()).decode('ascii')}"


def load_picture(view: View, long_side: int) -> Picture:
    """Read a frame and its mask; reduce by area averaging to ``long_side`` px where it is larger.

    Raises InputError when an image cannot be read, StoreError when the mask differs in size.
    """
    rgb = read_rgb(view.image)
    mask = read_mask(view.mask) if view.mask else None
    if mask is not None:
        if mask.shape != rgb.shape[:2]:
            raise StoreError(
                f"the mask {view.mask} differs in size from its image", hint="run again with --force ingest"
            )
        rgb = np.where(mask[..., None] > 0, rgb, np.uint8(_MASKED))
    height, width = rgb.shape[:2]
    scale = long_side / max(height, width)
    if scale < 1.0:
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        rgb = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
    return Picture(rgb, mask is not None and not mask.all())


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
