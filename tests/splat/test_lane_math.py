"""Exponential and logarithm of the vector loops against NumPy, and the machine code of such loops."""

from __future__ import annotations

import platform

import numba
import numpy as np
import pytest
from numba import njit, types

from cleargs.splat.kernels.cpu import gradients, lane_math, projection
from cleargs.splat.kernels.cpu.jit import FAST

RNG = np.random.default_rng(0)


@njit(error_model="numpy", fastmath=set(FAST))
def both(x, by_exp, by_log):
    for i in range(x.size):
        by_exp[i] = lane_math.exp(x[i])
        by_log[i] = lane_math.log2(x[i])


def evaluated(values):
    x = np.array(values, np.float64)
    by_exp, by_log = np.empty_like(x), np.empty_like(x)
    both(x, by_exp, by_log)
    return by_exp, by_log


def test_exp_and_log_are_exact_to_a_few_units_in_the_last_place():
    x = np.concatenate([RNG.uniform(-700, 700, 4096), RNG.normal(size=4096)])
    assert np.abs(evaluated(x)[0] / np.exp(x) - 1).max() < 2e-15
    positive = np.concatenate([np.exp(x), 1 + np.abs(x[4096:]) * 1e-9])
    assert np.abs(evaluated(positive)[1] - np.log2(positive)).max() < 3e-13  # logarithms are up to 1010
    near = 1 + np.linspace(-0.2, 0.2, 4096)
    np.testing.assert_allclose(evaluated(near)[1], np.log2(near), rtol=2e-15, atol=1e-17)


def test_values_without_a_result():
    by_exp, by_log = evaluated([np.nan, np.inf, -np.inf, 0.0, 1e4, -1e4])
    assert np.isnan(by_exp[0]) and np.isnan(by_log[[0, 1, 2]]).all()
    assert (by_exp[[1, 4]] > 1e307).all() and (by_exp[[2, 5]] < 1e-307).all() and by_exp[3] == 1.0
    assert by_log[3] == pytest.approx(-1023)


@pytest.mark.skipif(platform.machine().lower() not in ("x86_64", "amd64"), reason="x86 instructions")
def test_geometry_is_vector_code():
    """Scalar code takes nearly twice as long."""
    view = numba.typeof(projection.ProjectionView(*[1.0] * 23))
    rows = types.float64[:, ::1]

    @njit(error_model="numpy", fastmath=set(FAST))
    def lanes(view, antialias):
        rows = np.empty((gradients.ROWS, lane_math.GROUP))
        projection.set_poses(view, rows)
        gradients.backpropagate_lanes(view, antialias, rows)
        return rows

    lanes.compile((view, types.boolean))
    assert lanes.nopython_signatures[0].return_type == rows
    code = lanes.inspect_asm((view, types.boolean))
    assert code.count("mulpd") > 100 > 10 * code.count("mulsd")
