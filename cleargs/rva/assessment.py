"""All of RVA's maths in one call: cues, poses and observations in, the rows of both tables out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from scipy import sparse

from cleargs.rva.allocation import (
    Role,
    Roles,
    keep_sharp,
    reactivate,
    reactivation_gain,
    standard_roles,
    supervision_weights,
)
from cleargs.rva.config import RvaConfig
from cleargs.rva.geometry import (
    Ints,
    camera_centres,
    coverage_gain,
    geometric_utility,
    pose_diversity,
    redundancy,
    view_directions,
    visibility,
)
from cleargs.rva.scores import Bools, Floats, appearance_scores, is_reliable, stand_in_set
from cleargs.rva.trajectory import cumulative_motion, cut_into_bins

S = TypeVar("S", bound=np.generic)


@dataclass(frozen=True)
class Poses:
    """World-to-camera poses (OpenCV axes) of N frames; rows of unregistered frames are not read."""

    rotations: Floats  # [N, 3, 3]
    translations: Floats  # [N, 3]
    registered: Bools  # [N]


@dataclass(frozen=True)
class Observations:
    """Which frame observes which point: the paper's P_i as pairs."""

    frame_id: Ints  # [M]
    point_id: Ints  # [M]


@dataclass(frozen=True)
class Assessment:
    """One entry a frame, in the order given; geometry is NaN (bin -1) where the frame is unregistered
    or not scored."""

    R: Floats
    B: Floats
    reliable: Bools
    stand_in: Bools
    C: Floats
    D: Floats
    O: Floats
    G: Floats
    bin: npt.NDArray[np.int32]
    Z: Floats
    role: Roles
    reactivated_for: Roles  # a `Rule`, "" where the frame is not reactivated
    weight: Floats
    covered: Bools  # [bins] active frames before reactivation
    bin_edges: Floats  # [bins + 1] cumulative pose motion


def assess(
    frame_id: Ints,  # [N] distinct; orders the trajectory
    cues: Floats,  # [N, 11] in [0, 1]; NaN in the row of a frame that could not be scored
    poses: Poses,
    observations: Observations,
    config: RvaConfig,
) -> Assessment:
    """Scores, geometry, bins, roles and weights of the training frames.

    Observations by other frames (held-out ones, say) and by unregistered frames are ignored: neither P_rel
    nor n_p knows of them. A frame that could not be scored is treated like one without a pose, its points
    included. Permuting the rows of the arguments permutes the result. With ``config.enabled``
    false every registered frame is strong with weight 1, with ``config.weighting`` "binary" the better ones
    are; all other columns stay what they are.
    """
    R, B = appearance_scores(cues, config)
    by_id = np.argsort(frame_id, kind="stable")
    usable = poses.registered & ~np.isnan(cues).any(axis=1)
    rows = by_id[usable[by_id]]  # the trajectory: registered and scored frames by frame_id
    r, b = R[rows], B[rows]

    reliable = is_reliable(r, b, config)
    stand_in = np.zeros(len(rows), dtype=bool) if reliable.any() else stand_in_set(r, b, config)
    reference = reliable | stand_in
    centres = camera_centres(poses.rotations[rows], poses.translations[rows])
    directions = view_directions(poses.rotations[rows])
    seen = _seen_by(frame_id[rows], observations)
    C = coverage_gain(seen, reference)
    D = pose_diversity(centres, directions, reference, config)
    overlap = redundancy(seen, reference)
    G = geometric_utility(C, D, overlap, config)
    bins = cut_into_bins(cumulative_motion(centres, directions, config), config.frames_per_bin)
    roles = standard_roles(r, b, G, config)
    covered = np.isin(np.arange(len(bins.edges) - 1), bins.index[roles != Role.SUPPRESSED])
    rules = np.full_like(roles, "")
    if config.coverage and config.weighting == "graded":
        gain = reactivation_gain(r, b, G, bins.centrality, config)
        rules = reactivate(roles, bins.index, gain, config)
        roles = np.where(rules != "", Role.REACTIVATED.value, roles)
    weight = supervision_weights(roles, r, G, config)
    if config.weighting == "binary":
        roles, weight = keep_sharp(r, b, config.binary_share, config)
    if not config.enabled:
        roles, weight = np.full_like(roles, Role.STRONG.value), np.ones(len(rows))
        rules = np.full_like(rules, "")

    def spread(values: npt.NDArray[S], elsewhere: object) -> npt.NDArray[S]:
        """Rows of the trajectory back to the rows of the arguments; ``elsewhere`` for the other frames."""
        whole = np.full(len(frame_id), elsewhere, dtype=values.dtype)
        whole[rows] = values
        return whole

    nan = float("nan")
    return Assessment(
        R=R,
        B=B,
        reliable=spread(reliable, False),
        stand_in=spread(stand_in, False),
        C=spread(C, nan),
        D=spread(D, nan),
        O=spread(overlap, nan),
        G=spread(G, nan),
        bin=spread(bins.index, -1),
        Z=spread(bins.centrality, nan),
        role=spread(roles, Role.SUPPRESSED.value),
        reactivated_for=spread(rules, ""),
        weight=spread(weight, 0.0),
        covered=covered,
        bin_edges=bins.edges,
    )


def _seen_by(frame_id: Ints, observations: Observations) -> sparse.csr_array:  # [N] ascending -> [N, P]
    """The point sets of the given frames; what other frames observe is left out."""
    kept = np.isin(observations.frame_id, frame_id)
    row = np.searchsorted(frame_id, observations.frame_id[kept])
    return visibility(row, observations.point_id[kept], len(frame_id))
