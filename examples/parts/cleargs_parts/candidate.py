"""A candidate of RIVR: rivr.candidates=["mean"] adds the mean of render and restored frame to the choice."""

import numpy as np

from cleargs.rivr.candidates import Candidate, Materials
from cleargs.types import ImageF32


def make(images: Materials) -> ImageF32:
    """Return an image [H, W, 3] float32 sRGB in [0, 1]."""
    return np.float32(0.5) * (images.render + images.restored)


MEAN = Candidate("Mean", "the mean of render and restored frame", make)
