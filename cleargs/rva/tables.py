"""Schemas of the RVA tables: training frames only, in trajectory order, by ``frame_id``."""

from __future__ import annotations

import pyarrow as pa

from cleargs.parquet import column

R_CUES = ("sharpness", "structure", "texture", "cleanness", "exposure")
"""The quality cues r_i in the paper's order."""
B_CUES = ("motion_blur", "defocus", "ghosting", "exposure_failure", "unreliable_texture", "artifacts")
"""The degradation cues b_i in the paper's order."""
CUE_COLUMNS = tuple(f"r_{name}" for name in R_CUES) + tuple(f"b_{name}" for name in B_CUES)
"""Columns of a cue array [n, 11]."""


def _score(name: str, meaning: str, *, nullable: bool = False) -> pa.Field:
    return column(name, pa.float64(), f"{meaning}, in [0, 1]", nullable=nullable)


def _appearance(name: str, meaning: str) -> pa.Field:
    return _score(name, f"{meaning}; null if the frame could not be scored", nullable=True)


def _geometry(name: str, meaning: str) -> pa.Field:
    return _score(name, f"{meaning}; null if the frame is not registered or not scored", nullable=True)


FRAMES = pa.schema(
    [
        column("frame_id", pa.int32(), "id of the frame in ingest/frames; orders the trajectory"),
        column("name", pa.string(), "name of the frame in the capture"),
        column("evaluator", pa.string(), "evaluator of the appearance: name-version, with the model's name"),
        *(_appearance(f"r_{name}", f"quality cue {name.replace('_', ' ')}, 1 is best") for name in R_CUES),
        *(
            _appearance(f"b_{name}", f"degradation cue {name.replace('_', ' ')}, 1 is worst")
            for name in B_CUES
        ),
        _appearance("R", "appearance reliability, w_R . r"),
        _appearance("B", "degradation risk, w_B . b"),
        column("reliable", pa.bool_(), "in the set A: registered, R >= tau_R and B <= tau_B"),
        _geometry("C", "coverage gain over the points of the reliable frames"),
        _geometry("D", "pose diversity: largest pose distance to another reliable frame"),
        _geometry("O", "visibility redundancy: largest overlap (IoU of points) with another reliable frame"),
        _geometry("G", "geometric utility, clip(alpha C + beta D - eta O)"),
        column("bin", pa.int32(), "trajectory bin, from 0; null if C is null", nullable=True),
        _geometry("Z", "centrality in the bin, 1 at its middle"),
        column("role", pa.string(), "strong, geometric, auxiliary, reactivated or suppressed"),
        _score("weight", "weight of the frame's raw supervision; 0: the frame is not used"),
        column(
            "fallback",
            pa.bool_(),
            "no frame is reliable, and this one is among the best by R - B that replace the set A in C, D "
            "and O (roles do not change)",
        ),
        column(
            "reactivated_for",
            pa.string(),
            "reason to reactivate a suppressed frame: coverage (no active frame in its bin) or active_share "
            "(too few in the capture); null for other frames",
            nullable=True,
        ),
    ]
)

BINS = pa.schema(
    [
        column("bin", pa.int32(), "trajectory bin, from 0"),
        column("s_start", pa.float64(), "cumulative pose motion at which the bin starts"),
        column("s_end", pa.float64(), "cumulative pose motion at which the bin ends"),
        column("n_frames", pa.int32(), "registered training frames in the bin"),
        column("n_active", pa.int32(), "those with a weight above 0, including reactivated frames"),
        column("covered", pa.bool_(), "the bin had an active frame before reactivation"),
        column("reactivated", pa.list_(pa.int32()), "frame_id of the reactivated frames, in ascending order"),
    ]
)
