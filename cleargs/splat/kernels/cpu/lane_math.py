"""Exponential and logarithm for loops that LLVM turns into vector code.

A call of the C library keeps a loop scalar. These functions are arithmetic and bit patterns, so LLVM computes
several Gaussians at once. They are exact to a few units in the last place. NaN gives NaN.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cleargs.splat.kernels.cpu.jit import inlined

GROUP = 64
"""Gaussians per loop. A fixed number: a remainder loop could round differently, and the result of a Gaussian
must not depend on its neighbours."""

_LARGEST = 708.0
"""Bound of the exponent, in which the result is a normal float64."""
_LOG2E = math.log2(math.e)
_LN2_HIGH = 0.6931471803691238  # ends in zeros, so its product with a whole number is exact
_LN2_LOW = 1.9082149292705877e-10  # the rest of ln 2
_TAYLOR = tuple(1.0 / math.factorial(n) for n in range(12, -1, -1))
_SHIFT = 1.5 * 2.0**52
"""Added to a float64, it leaves a whole number in the low bits."""
_EXPONENT, _BIAS = np.int64(52), np.int64(1023)
_MANTISSA, _ONE = np.int64(2**52 - 1), np.int64(1023 << 52)
_WHOLE = np.int64(1075 << 52)  # bits of 2^52
_WHOLE_BIAS = 2.0**52 + 1023
_SQRT2 = math.sqrt(2.0)
_SERIES = tuple(2.0 * _LOG2E / (2 * n + 1) for n in range(10, -1, -1))


@inlined
def exp(x: Any) -> Any:
    """Return e^x for a float64. It is at most e^708 and at least e^-708."""
    bounded = -_LARGEST if x < -_LARGEST else x
    bounded = _LARGEST if bounded > _LARGEST else bounded
    shifted = bounded * _LOG2E + _SHIFT
    whole = shifted - _SHIFT
    rest = bounded - whole * _LN2_HIGH - whole * _LN2_LOW
    series = 0.0
    for coefficient in _TAYLOR:
        series = series * rest + coefficient
    return series * np.int64((np.float64(shifted).view(np.int64) + _BIAS) << _EXPONENT).view(np.float64)


@inlined
def log2(x: Any) -> Any:
    """Return the logarithm to base 2 of a normal float64 above 0; about -1023 for 0, and NaN for infinity."""
    bits = np.float64(x).view(np.int64)
    mantissa = np.int64((bits & _MANTISSA) | _ONE).view(np.float64)
    exponent = np.int64((bits >> _EXPONENT) | _WHOLE).view(np.float64) - _WHOLE_BIAS
    large = mantissa > _SQRT2
    mantissa = 0.5 * mantissa if large else mantissa
    exponent = exponent + 1.0 if large else exponent
    ratio = (mantissa - 1.0) / (mantissa + 1.0)
    square = ratio * ratio
    series = 0.0
    for coefficient in _SERIES:
        series = series * square + coefficient
    return exponent + ratio * series + (x - x)
