"""Schemas of the tables of a training: one row per step, and one row per frame with its exposure."""

from __future__ import annotations

import pyarrow as pa

from cleargs.parquet import column

TRAIN = pa.schema(
    [
        column("round", pa.int32(), "round of the stage, 0 if it has none"),
        column("step", pa.int32(), "step within the round, from 1"),
        column("frame_id", pa.int32(), "frame of the view"),
        column("kind", pa.string(), "real (the frame itself) or pseudo (its repair)"),
        column("weight", pa.float32(), "factor on this step's loss"),
        column("width", pa.int32(), "width of the training image, px"),
        column("height", pa.int32(), "height of the training image, px"),
        column("loss", pa.float64(), "weighted L1 + D-SSIM, without regularisation"),
        column("l1", pa.float64(), "mean absolute error over unmasked pixels, sRGB in [0, 1]"),
        column("ssim", pa.float64(), "mean SSIM over unmasked pixels"),
        column("psnr", pa.float64(), "PSNR over unmasked pixels before the step, dB"),
        column("n_gaussians", pa.int32(), "number of rendered Gaussians"),
        column("sh_degree", pa.int32(), "rendered SH degree"),
    ]
)

EXPOSURE = pa.schema(
    [
        column("frame_id", pa.int32(), "active frame"),
        *(
            column(
                f"a{row}{col}", pa.float64(), f"affine on sRGB, row {row} ({'rgb'[row]} out), column {col}"
            )
            for row in range(3)
            for col in range(4)
        ),
    ]
)
