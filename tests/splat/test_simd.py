"""The SIMD type against NumPy, and the machine code of the hot loops."""

from __future__ import annotations

import platform

import numpy as np
import pytest
from numba import njit, types

from cleargs.splat.kernels.cpu import rasterise, simd

RNG = np.random.default_rng(0)
LANES = simd.LANES
X, Y = RNG.normal(size=(2, LANES)).astype(np.float32)
HALF = np.float32(0.5)


@njit
def arithmetic(x, y, out):
    a, b = simd.load(x, 0), simd.load(y, 0)
    simd.store(out, 0, a + b)
    simd.store(out, 1 * LANES, a - HALF)
    simd.store(out, 2 * LANES, HALF * b)
    simd.store(out, 3 * LANES, a / b)
    simd.store(out, 4 * LANES, simd.minimum(a, b))
    simd.store(out, 5 * LANES, simd.maximum(a, b))
    simd.store(out, 6 * LANES, simd.select(a < b, a, simd.broadcast(HALF)))
    simd.store(out, 7 * LANES, simd.negative_magnitude(a))
    simd.store(out, 8 * LANES, simd.magnitude(a))
    simd.store(out, 9 * LANES, simd.lane_numbers())


def test_arithmetic():
    out = np.empty(10 * LANES, np.float32)
    arithmetic(X, Y, out)
    expected = [
        X + Y, X - HALF, HALF * Y, X / Y, np.minimum(X, Y), np.maximum(X, Y),
        np.where(X < Y, X, HALF), -np.abs(X), np.abs(X), np.arange(LANES),
    ]  # fmt: skip
    np.testing.assert_allclose(out.reshape(10, LANES), np.stack(expected), rtol=1e-6)


@njit
def masks(x, y):
    a, b = simd.load(x, 0), simd.load(y, 0)
    return (
        simd.mask_bits(a >= b),
        simd.mask_bits(a > HALF),
        simd.mask_bits(a <= b),
        simd.any_lane(a > HALF),
        simd.any_lane(a > np.float32(1e9)),
        simd.lowest_bit(np.int64(40)),
    )


def test_masks():
    def bits(condition):
        return int((condition * 2 ** np.arange(LANES)).sum())

    assert masks(X, Y) == (bits(X >= Y), bits(X > HALF), bits(X <= Y), True, False, 3)


@njit
def sums(rows, out):
    simd.store_lane_sums(
        out, 0,
        simd.load(rows, 0), simd.load(rows, LANES), simd.load(rows, 2 * LANES), simd.load(rows, 3 * LANES),
        simd.load(rows, 4 * LANES), simd.load(rows, 5 * LANES), simd.load(rows, 6 * LANES),
        simd.load(rows, 7 * LANES),
    )  # fmt: skip
    return simd.lane_sum(simd.load(rows, LANES))


def test_sums():
    rows, out = RNG.normal(size=(8, LANES)).astype(np.float32), np.empty(8, np.float32)
    total = sums(rows.ravel(), out)
    np.testing.assert_allclose(out, rows.sum(1), rtol=1e-5, atol=1e-6)
    assert total == pytest.approx(rows[1].sum(), rel=1e-5)


def test_exp2_polynomial():
    t = np.linspace(-8.5, 0, LANES * 500, dtype=np.float32)
    out = np.empty_like(t)

    @njit
    def evaluate(values, result):
        for i in range(0, values.size, LANES):
            simd.store(result, i, rasterise.exp2(simd.load(values, i)))

    evaluate(t, out)
    assert np.abs(out / np.exp2(t.astype(np.float64)) - 1).max() < 3e-6
    far = np.full(LANES, -1e30, np.float32)
    evaluate(far, far)
    assert (far < 1 / 255).all()


@pytest.mark.skipif(platform.machine().lower() not in ("x86_64", "amd64"), reason="x86 instructions")
@pytest.mark.parametrize("direction", ["forward", "backward"])
def test_hot_loops_use_no_masked_stores(direction):
    """vmaskmov is microcoded on AMD and nearly doubled the forward pass."""
    matrix, vector, ids = types.float32[:, ::1], types.float32[::1], types.uint32[::1]
    place = (types.int64, types.int64, types.float32, types.float32)
    touches = types.int64[::1]
    if direction == "forward":
        function, arguments = rasterise.forward_tile, (*place, ids, matrix, vector, touches, types.none)
    else:
        function, arguments = (
            rasterise.backward_tile,
            (*place, ids, ids, matrix, vector, touches, matrix, types.none),
        )
    function.compile(arguments)
    assembly = function.inspect_asm(arguments)
    assert "mulps" in assembly or "fmadd" in assembly
    assert "vmaskmov" not in assembly
