"""The SIMD type against NumPy, and what the compiler makes of the hot loops."""

from __future__ import annotations

import platform

import numpy as np
import pytest
from numba import njit, types

from cleargs.splat.kernels.cpu import rasterise, simd

RNG = np.random.default_rng(0)
X, Y = RNG.normal(size=(2, 8)).astype(np.float32)
HALF = np.float32(0.5)


@njit
def arithmetic(x, y, out):
    a, b = simd.load8(x, 0), simd.load8(y, 0)
    simd.store8(out, 0, a + b)
    simd.store8(out, 8, a - HALF)
    simd.store8(out, 16, HALF * b)
    simd.store8(out, 24, a / b)
    simd.store8(out, 32, simd.min8(a, b))
    simd.store8(out, 40, simd.max8(a, b))
    simd.store8(out, 48, simd.select8(a < b, a, simd.broadcast8(HALF)))
    simd.store8(out, 56, simd.negative_magnitude8(a))
    simd.store8(out, 64, simd.abs8(a))
    simd.store8(out, 72, simd.lane_numbers())


def test_arithmetic():
    out = np.empty(80, np.float32)
    arithmetic(X, Y, out)
    expected = [
        X + Y, X - HALF, HALF * Y, X / Y, np.minimum(X, Y), np.maximum(X, Y),
        np.where(X < Y, X, HALF), -np.abs(X), np.abs(X), np.arange(8),
    ]  # fmt: skip
    np.testing.assert_allclose(out.reshape(10, 8), np.stack(expected), rtol=1e-6)


@njit
def masks(x, y):
    a, b = simd.load8(x, 0), simd.load8(y, 0)
    return (
        simd.mask_bits(a >= b),
        simd.mask_bits(a > HALF),
        simd.mask_bits(a <= b),
        simd.any8(a > HALF),
        simd.any8(a > np.float32(1e9)),
        simd.lowest_bit(np.int64(40)),
    )


def test_masks():
    def bits(condition):
        return int((condition * 2 ** np.arange(8)).sum())

    assert masks(X, Y) == (bits(X >= Y), bits(X > HALF), bits(X <= Y), True, False, 3)


@njit
def sums(rows, out):
    simd.store8(
        out, 0,
        simd.lane_sums(
            simd.load8(rows, 0), simd.load8(rows, 8), simd.load8(rows, 16), simd.load8(rows, 24),
            simd.load8(rows, 32), simd.load8(rows, 40), simd.load8(rows, 48), simd.load8(rows, 56),
        ),
    )  # fmt: skip
    return simd.lane_sum(simd.load8(rows, 8))


def test_sums():
    rows, out = RNG.normal(size=64).astype(np.float32), np.empty(8, np.float32)
    total = sums(rows, out)
    np.testing.assert_allclose(out, rows.reshape(8, 8).sum(1), rtol=1e-5, atol=1e-6)
    assert total == pytest.approx(rows[8:16].sum(), rel=1e-5)


def test_exp2_polynomial():
    t = np.linspace(-8.5, 0, 8 * 500, dtype=np.float32)
    out = np.empty_like(t)

    @njit
    def evaluate(values, result):
        for i in range(0, values.size, 8):
            simd.store8(result, i, rasterise.exp2_8(simd.load8(values, i)))

    evaluate(t, out)
    assert np.abs(out / np.exp2(t.astype(np.float64)) - 1).max() < 3e-6
    far = np.full(8, -1e30, np.float32)
    evaluate(far, far)
    assert (far < 1 / 255).all()


@pytest.mark.skipif(platform.machine().lower() not in ("x86_64", "amd64"), reason="x86 instructions")
@pytest.mark.parametrize("direction", ["forward", "backward"])
def test_hot_loops_use_no_masked_stores(direction):
    """vmaskmov is microcoded on AMD and nearly doubled the forward pass."""
    matrix, vector, ids = types.float32[:, ::1], types.float32[::1], types.uint32[::1]
    place = (types.int64, types.int64, types.float32, types.float32)
    if direction == "forward":
        function, arguments = rasterise.forward_tile, (*place, ids, matrix, vector, types.none)
    else:
        function, arguments = rasterise.backward_tile, (*place, ids, ids, matrix, vector, matrix, types.none)
    function.compile(arguments)
    assembly = function.inspect_asm(arguments)
    assert "mulps" in assembly or "fmadd" in assembly
    assert "vmaskmov" not in assembly
