"""All RVA computations in one call: from cues, poses and observations to the two tables and the summary."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from cleargs.capture.tables import Frame
from cleargs.rva import allocation, geometry
from cleargs.rva.allocation import Role, Roles, Rule
from cleargs.rva.config import AssessmentConfig
from cleargs.rva.tables import BINS, CUE_COLUMNS, FRAMES
from cleargs.types import ArrayBool, ArrayF64, ArrayInt

S = TypeVar("S", bound=np.generic)


@dataclass(frozen=True)
class Poses:
    """World-to-camera poses (OpenCV axes) of N frames. The values of unregistered frames are not used."""

    rotations: ArrayF64  # [N, 3, 3]
    translations: ArrayF64  # [N, 3]
    registered: ArrayBool  # [N]


@dataclass(frozen=True)
class Observations:
    """Pairs of a frame and a point that it observes: the paper's sets P_i."""

    frame_id: ArrayInt  # [M]
    point_id: ArrayInt  # [M]


@dataclass(frozen=True)
class Assessment:
    """Results per frame, in the order of the arguments of `assess`; symbols as in the paper.

    The geometry of unregistered and unscored frames is NaN (bin -1).
    """

    R: ArrayF64
    B: ArrayF64
    reliable: ArrayBool
    fallback: ArrayBool
    C: ArrayF64
    D: ArrayF64
    O: ArrayF64
    G: ArrayF64
    bin: npt.NDArray[np.int32]
    Z: ArrayF64
    role: Roles
    reactivated_for: Roles  # a `Rule`; "" for frames that are not reactivated
    weight: ArrayF64
    covered: ArrayBool  # [bins] active frames before reactivation
    bin_edges: ArrayF64  # [bins + 1] cumulative pose motion


def assess(
    frame_id: ArrayInt,  # [N] distinct; orders the trajectory
    cues: ArrayF64,  # [N, 11] in [0, 1]; NaN in the row of an unscored frame
    poses: Poses,
    observations: Observations,
    config: AssessmentConfig,
) -> Assessment:
    """Compute scores, geometry, bins, roles and weights of the training frames.

    Observations by held-out or unregistered frames are ignored: they count neither in P_rel nor in n_p. An
    unscored frame is treated like an unregistered one. A permutation of the arguments' rows permutes the
    result. With ``config.enabled`` false all registered frames are strong with weight 1. With ``weighting``
    "binary" the better ones get weight 1, the others 0. Other results do not change.
    """
    R, B = allocation.appearance_scores(cues, config)
    by_id = np.argsort(frame_id, kind="stable")
    usable = poses.registered & ~np.isnan(cues).any(axis=1)
    rows = by_id[usable[by_id]]  # the trajectory: rows of registered and scored frames, by frame_id
    r, b = R[rows], B[rows]

    reliable = allocation.is_reliable(r, b, config)
    # Without a reliable frame, the best by R - B replace them in the geometry.
    fallbacks = 0 if reliable.any() else max(1, round(config.fallback_share * len(r)))
    fallback = allocation.best_frames(r, b, fallbacks)
    reference = reliable | fallback
    rotations = poses.rotations[rows]
    centres = np.asarray(-np.einsum("nij,ni->nj", rotations, poses.translations[rows]))  # -R^T t
    directions = rotations[:, 2, :]  # OpenCV axes, z forward
    seen = geometry.visibility(frame_id[rows], observations.frame_id, observations.point_id)
    C = geometry.coverage_gain(seen, reference)
    D = geometry.pose_diversity(centres, directions, reference, config)
    overlap = geometry.redundancy(seen, reference)
    # Paper, eq. vista_geometry.
    G = np.clip(config.alpha * C + config.beta * D - config.eta * overlap, 0.0, 1.0)
    bins = geometry.cut_into_bins(
        geometry.cumulative_motion(centres, directions, config), config.frames_per_bin
    )
    roles = allocation.standard_roles(r, b, G, config)
    covered = np.isin(np.arange(len(bins.edges) - 1), bins.index[roles != Role.SUPPRESSED])
    rules = np.full_like(roles, "")
    if config.coverage and config.weighting == "graded":
        gain = allocation.reactivation_gain(r, b, G, bins.centrality, config)
        rules = allocation.reactivate(roles, bins.index, gain, config)
        roles = np.where(rules != "", Role.REACTIVATED.value, roles)
    weight = allocation.supervision_weights(roles, r, G, config)
    if config.weighting == "binary":
        roles, weight = allocation.binary_roles(r, b, config)
    if not config.enabled:
        roles, weight = np.full_like(roles, Role.STRONG.value), np.ones(len(rows))
        rules = np.full_like(rules, "")

    def scatter(values: npt.NDArray[S], fill: object) -> npt.NDArray[S]:
        """Return values of the trajectory in the order of the arguments, with ``fill`` for other frames."""
        whole = np.full(len(frame_id), fill, dtype=values.dtype)
        whole[rows] = values
        return whole

    nan = float("nan")
    return Assessment(
        R=R,
        B=B,
        reliable=scatter(reliable, False),
        fallback=scatter(fallback, False),
        C=scatter(C, nan),
        D=scatter(D, nan),
        O=scatter(overlap, nan),
        G=scatter(G, nan),
        bin=scatter(bins.index, -1),
        Z=scatter(bins.centrality, nan),
        role=scatter(roles, Role.SUPPRESSED.value),
        reactivated_for=scatter(rules, ""),
        weight=scatter(weight, 0.0),
        covered=covered,
        bin_edges=bins.edges,
    )


def poses_from(frames: Sequence[Frame]) -> Poses:
    """Return the poses of ``frames``; the identity for unregistered frames."""
    rotations = np.tile(np.eye(3), (len(frames), 1, 1))
    translations = np.zeros((len(frames), 3))
    registered = np.array([frame.registered for frame in frames], dtype=bool)
    for number, frame in enumerate(frames):
        if frame.registered:
            pose = frame.pose
            rotations[number], translations[number] = pose.rotation, pose.translation
    return Poses(rotations, translations, registered)


def frames_table(
    frame_id: npt.NDArray[np.int32],  # [N] ascending
    names: Sequence[str],
    evaluator: str,
    cues: ArrayF64,  # [N, 11], NaN for unscored frames
    result: Assessment,
) -> pa.Table:
    """Return the table of rva/frames.parquet. NaN becomes null."""
    nulls = dict.fromkeys(("C", "D", "O", "G", "bin", "Z"), result.bin < 0)
    nulls["reactivated_for"] = result.reactivated_for == ""
    columns: dict[str, Any] = {
        "frame_id": frame_id,
        "name": list(names),
        "evaluator": [evaluator] * len(names),
        **{column: pa.array(cues[:, k], from_pandas=True) for k, column in enumerate(CUE_COLUMNS)},
        **{
            field.name: pa.array(getattr(result, field.name), mask=nulls.get(field.name), from_pandas=True)
            for field in fields(result)
            if field.name in FRAMES.names
        },
    }
    return pa.table(columns, schema=FRAMES)


def bins_table(frame_id: npt.NDArray[np.int32], result: Assessment) -> pa.Table:  # [N] ascending
    """Return the table of rva/bins.parquet."""
    count = len(result.covered)
    placed = result.bin[result.bin >= 0]
    active = result.bin[(result.bin >= 0) & (result.weight > 0.0)]
    reactivated = result.role == Role.REACTIVATED
    return pa.table(
        {
            "bin": np.arange(count, dtype=np.int32),
            "s_start": result.bin_edges[:-1],
            "s_end": result.bin_edges[1:],
            "n_frames": np.bincount(placed, minlength=count).astype(np.int32),
            "n_active": np.bincount(active, minlength=count).astype(np.int32),
            "covered": result.covered,
            "reactivated": [frame_id[reactivated & (result.bin == k)] for k in range(count)],
        },
        schema=BINS,
    )


def summary(result: Assessment, evaluator: str) -> dict[str, Any]:
    """Return figures for the manifest: frames per role, a histogram of weights, effective sample size."""
    roles, rules = Counter(result.role.tolist()), Counter(result.reactivated_for.tolist())
    histogram, edges = np.histogram(result.weight, bins=10, range=(0.0, 1.0))
    return {
        "evaluator": evaluator,
        "frames": len(result.R),
        "registered": int(np.count_nonzero(result.bin >= 0)),
        "roles": {role.value: roles[role.value] for role in Role},
        "reactivated_for": {rule.value: rules[rule.value] for rule in Rule},
        "active": int(np.count_nonzero(result.weight)),
        "reliable": int(np.count_nonzero(result.reliable)),
        "fallback": int(np.count_nonzero(result.fallback)),
        "weights": {f"{edge:.1f}": int(n) for edge, n in zip(edges, histogram, strict=False)},
        "effective_frames": round(allocation.effective_sample_size(result.weight), 3),
        "bins": len(result.covered),
        "bins_uncovered_before": int(np.count_nonzero(~result.covered)),
    }
