"""Between RVA's arrays and its tables: poses in, rows and figures out, the frames that others measure on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from scipy.spatial.transform import Rotation

from cleargs.capture.tables import Frame
from cleargs.rva.allocation import Role, Rule, effective_sample_size
from cleargs.rva.assessment import Assessment, Poses
from cleargs.rva.scores import Floats
from cleargs.rva.tables import BINS, CUE_COLUMNS, FRAMES

_WEIGHT_STEPS = 10


def poses_from(frames: Sequence[Frame]) -> Poses:
    """Rotation matrices and translations, world to camera; identity where a frame has no pose."""
    rotations = np.tile(np.eye(3), (len(frames), 1, 1))
    translations = np.zeros((len(frames), 3))
    registered = np.array([frame.registered for frame in frames], dtype=bool)
    posed = [frame for frame in frames if frame.registered]
    if posed:
        quaternions = np.array([(f.qx, f.qy, f.qz, f.qw) for f in posed], dtype=np.float64)  # scipy: w last
        rotations[registered] = Rotation.from_quat(quaternions).as_matrix()
        translations[registered] = np.array([(f.tx, f.ty, f.tz) for f in posed], dtype=np.float64)
    return Poses(rotations, translations, registered)


def frames_table(
    frame_id: npt.NDArray[np.int32],  # [N] ascending
    names: Sequence[str],
    evaluator: str,
    cues: Floats,  # [N, 11], NaN where a frame could not be scored
    result: Assessment,
) -> pa.Table:
    """The rows of rva/frames.parquet; NaN becomes null."""
    placed = result.bin >= 0
    columns: dict[str, Any] = {
        "frame_id": frame_id,
        "name": list(names),
        "evaluator": [evaluator] * len(names),
        **{column: pa.array(cues[:, k], from_pandas=True) for k, column in enumerate(CUE_COLUMNS)},
        "R": pa.array(result.R, from_pandas=True),
        "B": pa.array(result.B, from_pandas=True),
        "reliable": result.reliable,
        **{
            column: pa.array(getattr(result, column), mask=~placed)
            for column in ("C", "D", "O", "G", "bin", "Z")
        },
        "role": result.role.tolist(),
        "weight": result.weight,
        "stand_in": result.stand_in,
        "reactivated_for": [rule or None for rule in result.reactivated_for.tolist()],
    }
    return pa.table(columns, schema=FRAMES)


def bins_table(frame_id: npt.NDArray[np.int32], result: Assessment) -> pa.Table:  # [N] ascending
    """The rows of rva/bins.parquet."""
    count = len(result.covered)
    placed = result.bin[result.bin >= 0]
    active = result.bin[(result.bin >= 0) & (result.weight > 0.0)]
    reactivated: list[list[int]] = [[] for _ in range(count)]
    for row in np.flatnonzero(result.role == Role.REACTIVATED):
        reactivated[result.bin[row]].append(int(frame_id[row]))
    return pa.table(
        {
            "bin": np.arange(count, dtype=np.int32),
            "s_start": result.bin_edges[:-1],
            "s_end": result.bin_edges[1:],
            "n_frames": np.bincount(placed, minlength=count).astype(np.int32),
            "n_active": np.bincount(active, minlength=count).astype(np.int32),
            "covered": result.covered,
            "reactivated": pa.array(reactivated, type=pa.list_(pa.int32())),
        },
        schema=BINS,
    )


def summary(result: Assessment, evaluator: str) -> dict[str, Any]:
    """Figures for the manifest: frames a role, weights in steps of 0.1, reliable frames, effective sample
    size.
    """
    roles, rules = Counter(result.role.tolist()), Counter(result.reactivated_for.tolist())
    histogram, _ = np.histogram(result.weight, bins=_WEIGHT_STEPS, range=(0.0, 1.0))
    return {
        "evaluator": evaluator,
        "frames": len(result.R),
        "registered": int(np.count_nonzero(result.bin >= 0)),
        "roles": {role.value: roles[role.value] for role in Role},
        "reactivated_for": {rule.value: rules[rule.value] for rule in Rule},
        "active": int(np.count_nonzero(result.weight)),
        "reliable": int(np.count_nonzero(result.reliable)),
        "stand_in": int(np.count_nonzero(result.stand_in)),
        "weights": {f"{k / _WEIGHT_STEPS:.1f}": int(histogram[k]) for k in range(_WEIGHT_STEPS)},
        "effective_frames": round(effective_sample_size(result.weight), 3),
        "bins": len(result.covered),
        "bins_uncovered_before": int(np.count_nonzero(~result.covered)),
    }
