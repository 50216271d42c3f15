"""Colour: sRGB and linear light, YCbCr to RGB, and HDR video to sRGB.

Arrays are float32 or float64 and keep their type.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

F = TypeVar("F", np.float32, np.float64)

LUMA = {"bt601": (0.299, 0.114), "bt709": (0.2126, 0.0722), "bt2020": (0.2627, 0.0593)}
"""Kr and Kb of each YCbCr matrix (ITU-R BT.601, BT.709, BT.2020)."""

TRANSFERS = {16: "pq", 18: "hlg"}
"""HDR transfer functions by their codes in files (ITU-T H.273)."""

REC709_FROM_REC2020 = np.array(
    [[1.660491, -0.587641, -0.072850], [-0.124550, 1.132900, -0.008349], [-0.018151, -0.100579, 1.118730]]
)
"""Linear RGB of BT.2020 primaries to BT.709 primaries (ITU-R BT.2087)."""

REFERENCE_WHITE = 203.0
"""Display luminance of HDR reference white, cd/m² (ITU-R BT.2408); linear 1 before the tone curve."""

HLG_PEAK = 1000.0
"""Nominal peak of the HLG display, cd/m² (ITU-R BT.2100: system gamma 1.2)."""

KNEE = 0.6
"""Linear value from which `tone_map` compresses highlights."""


def linear_from_srgb(srgb: NDArray[F]) -> NDArray[F]:
    """Convert sRGB in [0, 1] to linear light (IEC 61966-2-1). The linear part also holds below 0."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((np.maximum(srgb, 0.0) + 0.055) / 1.055) ** 2.4).astype(
        srgb.dtype
    )


def srgb_from_linear(linear: NDArray[F]) -> NDArray[F]:
    """Convert linear light in [0, 1] to sRGB (IEC 61966-2-1). The linear part also holds below 0."""
    return np.where(
        linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 0.0) ** (1 / 2.4) - 0.055
    ).astype(linear.dtype)


def rgb_from_yuv(yuv: NDArray[F], matrix: str, bits: int, *, full_range: bool) -> NDArray[F]:  # [3, H, W]
    """Convert Y'CbCr code values of ``bits`` bits to R'G'B' [H, W, 3], nominally in [0, 1] and not clipped.

    ``matrix`` is a key of `LUMA`. Limited range: Y 16..235, chroma 16..240 (times 2^(bits - 8)).
    """
    kr, kb = LUMA[matrix]
    step = 2.0 ** (bits - 8)
    peak = 2.0**bits - 1
    black, luma, chroma = (0.0, peak, peak) if full_range else (16 * step, 219 * step, 224 * step)
    y, u, v = (yuv[0] - black) / luma, (yuv[1] - 128 * step) / chroma, (yuv[2] - 128 * step) / chroma
    red = y + 2 * (1 - kr) * v
    blue = y + 2 * (1 - kb) * u
    green = (y - kr * red - kb * blue) / (1 - kr - kb)
    return np.stack([red, green, blue], axis=-1).astype(yuv.dtype)


def light_from_pq(signal: NDArray[F]) -> NDArray[F]:
    """Convert PQ code values in [0, 1] to display light, reference white = 1 (SMPTE ST 2084 EOTF)."""
    m1, m2 = 2610 / 16384, 2523 / 4096 * 128
    c1, c2, c3 = 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
    power = np.clip(signal, 0, 1) ** (1 / m2)
    nits = 10000 * (np.maximum(power - c1, 0) / (c2 - c3 * power)) ** (1 / m1)
    return np.asarray(nits / REFERENCE_WHITE, signal.dtype)


def light_from_hlg(signal: NDArray[F]) -> NDArray[F]:  # [H, W, 3]
    """Convert HLG R'G'B' in [0, 1] (BT.2020) to display light, reference white = 1 (ITU-R BT.2100)."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    signal = np.clip(signal, 0, 1)
    scene = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
    kr, kb = LUMA["bt2020"]
    luminance = scene @ np.array([kr, 1 - kr - kb, kb])
    nits = HLG_PEAK * np.maximum(luminance, 1e-9)[..., None] ** 0.2 * scene
    return np.asarray(nits / REFERENCE_WHITE, signal.dtype)


def tone_map(light: NDArray[F]) -> NDArray[F]:  # [H, W, 3]
    """Compress unbounded linear light to [0, 1).

    The curve is the identity up to `KNEE`. Above, it is the shoulder ``knee + (1 - knee) u / (1 + u)`` with
    ``u = (x - knee) / (1 - knee)``, which has slope 1 at the knee. x is the largest channel. All three
    channels are scaled by one factor, so that the hue does not change.
    """
    peak = light.max(axis=-1, keepdims=True)
    u = np.maximum(peak - KNEE, 0) / (1 - KNEE)
    bent = np.where(peak <= KNEE, peak, KNEE + (1 - KNEE) * u / (1 + u))
    return np.asarray(light * (bent / np.maximum(peak, 1e-9)), light.dtype)


def srgb_from_hdr(signal: NDArray[F], transfer: str) -> NDArray[F]:  # [H, W, 3]
    """Convert HDR R'G'B' of BT.2020 primaries to sRGB in [0, 1]; ``transfer`` is ``pq`` or ``hlg``."""
    light = light_from_pq(signal) if transfer == "pq" else light_from_hlg(signal)
    rec709 = np.maximum(light @ REC709_FROM_REC2020.T, 0).astype(signal.dtype)
    return srgb_from_linear(tone_map(rec709))
