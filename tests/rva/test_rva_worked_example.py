"""Five frames, twelve points and all five roles, with every number of both tables computed by hand."""

from __future__ import annotations

import numpy as np
import pytest
from rva_scenes import BACKWARD, FORWARD, along_x, observations_of, poses_at, uniform_cues

from cleargs.rva.allocation import effective_sample_size, reactivation_gain
from cleargs.rva.assessment import Assessment, assess, bins_table, frames_table, summary
from cleargs.rva.tables import CUE_COLUMNS
from cleargs.stages.rva import RvaConfig

FRAME_ID = np.arange(5, dtype=np.int32)

# Camera centres at x = 0, 1.5, 2, 6 and 10: the largest distance is 10. Frame 0 looks along +z, all others
# along -z: an angle of pi, d^v = 1, between frame 0 and any other, and 0 among the others.
POSES = poses_at(along_x([0.0, 1.5, 2.0, 6.0, 10.0]), np.stack([FORWARD, *[BACKWARD] * 4]))

# Point 4 is seen by frames 0, 2, 3 and 4: n_p = 4, weight 1/sqrt(4) = 0.5. All others have n_p = 1, weight 1.
POINTS = {0: [1, 2, 3, 4, 5], 1: [6, 7, 8], 2: [4, 9], 3: [4, 10], 4: [4, 11, 12]}

# frames_per_bin = 2 gives M = round(5 / 2) = round(2.5) = 2 bins (half to even).
CONFIG = RvaConfig(frames_per_bin=2, active_share=0.0)


def cues() -> np.ndarray:
    rows = uniform_cues([0.0, 0.2, 0.4, 0.1, 0.1], [0.0, 0.5, 0.6, 0.9, 0.9])
    rows[0] = [0.9, 0.8, 0.7, 1.0, 1.0, 0.1, 0.2, 0.0, 0.0, 0.4, 0.1]
    return rows


@pytest.fixture(scope="module")
def result() -> Assessment:
    return assess(FRAME_ID, cues(), POSES, observations_of(POINTS), CONFIG)


def near(*values: float) -> object:
    return pytest.approx(values, abs=1e-12)


def test_scores(result: Assessment) -> None:
    # R_0 = 0.30 x 0.9 + 0.25 x 0.8 + 0.20 x 0.7 + 0.15 x 1 + 0.10 x 1
    #     = 0.27 + 0.20 + 0.14 + 0.15 + 0.10 = 0.86
    # B_0 = 0.25 x 0.1 + 0.15 x 0.2 + 0.20 x 0 + 0.15 x 0 + 0.15 x 0.4 + 0.10 x 0.1
    #     = 0.025 + 0.03 + 0.06 + 0.01 = 0.125
    assert result.R.tolist() == near(0.86, 0.2, 0.4, 0.1, 0.1)
    assert result.B.tolist() == near(0.125, 0.5, 0.6, 0.9, 0.9)
    assert result.reliable.tolist() == [True, False, False, False, False]  # A = {0}
    assert not result.fallback.any()


def test_coverage_gain(result: Assessment) -> None:
    # P_rel = {1, 2, 3, 4, 5}
    # C_0 = 0; C_1 = 3 / 3; C_2 = 1 / (0.5 + 1) = 2/3; C_3 the same; C_4 = (1 + 1) / (0.5 + 1 + 1) = 0.8
    assert result.C.tolist() == near(0.0, 1.0, 2 / 3, 2 / 3, 0.8)


def test_pose_diversity(result: Assessment) -> None:
    # D_0: no other reliable frame. Else 0.65 x / 10 + 0.35 x 1:
    # D_1 = 0.0975 + 0.35; D_2 = 0.13 + 0.35; D_3 = 0.39 + 0.35; D_4 = 0.65 + 0.35
    assert result.D.tolist() == near(0.0, 0.4475, 0.48, 0.74, 1.0)


def test_redundancy(result: Assessment) -> None:
    # with P_0 (5 points): O_1 = 0 / 8; O_2 = 1 / (5 + 2 - 1); O_3 the same; O_4 = 1 / (5 + 3 - 1)
    assert result.O.tolist() == near(0.0, 0.0, 1 / 6, 1 / 6, 1 / 7)


def test_geometric_utility(result: Assessment) -> None:
    # G_0 = 0
    # G_1 = 0.45 + 0.35 x 0.4475 = 0.45 + 0.156625 = 0.606625
    # G_2 = 0.45 x 2/3 + 0.35 x 0.48 - 0.30 / 6 = 0.30 + 0.168 - 0.05 = 0.418
    # G_3 = 0.30 + 0.35 x 0.74 - 0.05 = 0.30 + 0.259 - 0.05 = 0.509
    # G_4 = 0.45 x 0.8 + 0.35 - 0.30 / 7 = 0.36 + 0.35 - 0.3 / 7
    assert result.G.tolist() == near(0.0, 0.606625, 0.418, 0.509, 0.71 - 0.3 / 7)


def test_bins(result: Assessment) -> None:
    # Steps of s: 0.65 x 0.15 + 0.35 = 0.4475; 0.65 x 0.05 = 0.0325; 0.65 x 0.4 = 0.26, twice; S = 1.
    # x = 2 s / S = 0, 0.895, 0.96, 1.48, 2.0; the last goes to bin M - 1 = 1
    assert result.bin.tolist() == [0, 0, 0, 1, 1]
    # Z = 1 - |2 (x - bin) - 1|: 1 - 1; 1 - 0.79; 1 - 0.92; 1 - |0.96 - 1|; 1 - |2 - 1|
    assert result.Z.tolist() == near(0.0, 0.21, 0.08, 0.96, 0.0)
    assert result.bin_edges.tolist() == near(0.0, 0.5, 1.0)
    assert result.covered.tolist() == [True, False]


def test_roles_and_weights(result: Assessment) -> None:
    # 0: R >= 0.70 and B <= 0.60: strong. 1: G >= 0.60 and B <= 0.80: geometric (R < 0.35).
    # 2: R >= 0.35, G >= 0.25, B <= 0.75: auxiliary (G < 0.60). 3 and 4: B > 0.80, nothing holds.
    # Bin 1 = {3, 4} is uncovered. Gains 0.35 G + 0.25 R + 0.30 (1 - B) + 0.10 Z:
    # 3: 0.17815 + 0.025 + 0.03 + 0.096 = 0.32915; 4: 0.2485 - 0.015 + 0.025 + 0.03 + 0 = 0.2885
    gain = reactivation_gain(result.R, result.B, result.G, result.Z, CONFIG)
    assert gain[3:].tolist() == near(0.32915, 0.2885)
    assert result.role.tolist() == ["strong", "geometric", "auxiliary", "reactivated", "suppressed"]
    # w_0 = 0.80 + 0.20 x 0.86 = 0.972
    # w_1 = 0.30 + 0.30 (0.35 x 0.2 + 0.65 x 0.606625) = 0.30 + 0.30 x 0.46430625 = 0.439291875
    # w_2 = 0.30 + 0.30 (0.5 x 0.4 + 0.5 x 0.418) = 0.30 + 0.30 x 0.409 = 0.4227
    assert result.weight.tolist() == near(0.972, 0.439291875, 0.4227, 0.12, 0.0)


@pytest.mark.parametrize(
    ("share", "rule", "role", "weight"),
    [
        (0.8, "", "suppressed", 0.0),  # 4 of 5 are active: enough
        (0.81, "active_share", "reactivated", 0.12),  # ceil(0.81 x 5) = 5 frames are wanted
    ],
)
def test_a_share_of_the_frames_is_active(share: float, rule: str, role: str, weight: float) -> None:
    result = assess(
        FRAME_ID, cues(), POSES, observations_of(POINTS), CONFIG.model_copy(update={"active_share": share})
    )
    assert result.reactivated_for.tolist() == ["", "", "", "coverage", rule]
    assert result.role.tolist() == ["strong", "geometric", "auxiliary", "reactivated", role]
    assert result.weight[4] == weight


def test_without_coverage_the_bin_stays_empty() -> None:
    bare = assess(
        FRAME_ID, cues(), POSES, observations_of(POINTS), CONFIG.model_copy(update={"coverage": False})
    )
    assert bare.role.tolist() == ["strong", "geometric", "auxiliary", "suppressed", "suppressed"]
    assert bare.weight[3] == 0.0


def test_all_view_weighs_all_frames_and_keeps_the_scores(result: Assessment) -> None:
    everything = assess(
        FRAME_ID, cues(), POSES, observations_of(POINTS), CONFIG.model_copy(update={"enabled": False})
    )
    assert set(everything.role.tolist()) == {"strong"}
    assert everything.weight.tolist() == [1.0] * 5
    assert everything.reliable.tolist() == result.reliable.tolist()
    assert everything.G.tolist() == result.G.tolist()


@pytest.mark.parametrize(
    ("share", "weights"),
    [
        # R - B = 0.735, -0.3, -0.2, -0.8, -0.8
        (0.2, [1, 0, 0, 0, 0]),  # ceil(0.2 x 5) = 1 frame
        (0.5, [1, 1, 1, 0, 0]),  # ceil(0.5 x 5) = 3
        (1.0, [1, 1, 1, 1, 1]),
    ],
)
def test_binary_weighting_keeps_the_better_share(share: float, weights: list[int]) -> None:
    dropped = assess(
        FRAME_ID,
        cues(),
        POSES,
        observations_of(POINTS),
        CONFIG.model_copy(update={"weighting": "binary", "binary_share": share}),
    )
    order = np.argsort(dropped.B - dropped.R, kind="stable")
    assert set(np.flatnonzero(dropped.weight)) == set(order[: sum(weights)])
    assert dropped.weight.tolist() == weights
    assert dropped.role[0] == "strong"
    assert "reactivated" not in dropped.role


def test_tables(result: Assessment) -> None:
    frames = frames_table(FRAME_ID, [f"{k}.png" for k in FRAME_ID], "hand-1", cues(), result)
    assert tuple(frames.column_names[3:14]) == CUE_COLUMNS
    assert frames.column("weight").to_pylist() == result.weight.tolist()
    bins = bins_table(FRAME_ID, result).to_pylist()
    assert [row["n_frames"] for row in bins] == [3, 2]
    assert [row["n_active"] for row in bins] == [3, 1]
    assert [row["reactivated"] for row in bins] == [[], [3]]
    assert frames.column("reactivated_for").to_pylist() == [None, None, None, "coverage", None]
    assert [row["covered"] for row in bins] == [True, False]


def test_summary(result: Assessment) -> None:
    figures = summary(result, "hand-1")
    assert figures["roles"] == {
        "strong": 1, "geometric": 1, "auxiliary": 1, "reactivated": 1, "suppressed": 1,
    }  # fmt: skip
    assert figures["active"] == 4
    assert figures["weights"]["0.4"] == 2
    # Kish's sample size of 4 equal weights is 4.
    assert effective_sample_size(np.array([0.5, 0.5, 0.5, 0.5, 0.0])) == pytest.approx(4.0)
    assert effective_sample_size(np.zeros(3)) == 0.0
