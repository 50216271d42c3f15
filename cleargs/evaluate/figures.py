"""Records that hold measured figures, which need not be finite."""

from __future__ import annotations

from pydantic import ConfigDict

from cleargs.record import Record


class Figures(Record):
    """A record whose JSON writes an infinite figure, as the PSNR of a perfect image, as ``"Infinity"``: JSON
    has no number for it. Read back, it is a number again."""

    model_config = ConfigDict(ser_json_inf_nan="strings")
