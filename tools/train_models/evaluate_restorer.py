"""Evaluate restoration experts on held-out photo sources.

    python -m tools.train_models.evaluate_restorer --photos DIR [--expert FILE.onnx] [--crop 256]

prints a Markdown table of the mean PSNR over the held-out photos for each band of blur lengths: the blurred
image, unsharp masking, Wiener deconvolution and the expert. Noise is at most 1/255, so that no gain comes
from denoising.

Unsharp masking and the blind Wiener filter are tuned per band on photos of the training sources, so they know
the band; the expert does not. The blind Wiener filter deconvolves by the mean kernel of the band, because the
direction is unknown. The other Wiener filter knows the true kernel and serves only as a reference.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cleargs.media.colour import linear_from_srgb, srgb_from_linear
from cleargs.models.expert import load_expert
from cleargs.types import ImageF32
from tools.train_models.degrade import IDENTITY, Degradation, Kernel, degrade, motion_kernel
from tools.train_models.train_restorer import list_photos, read_photo, source_of

BANDS = ((7, 11), (12, 16), (17, 21))
"""Shortest and longest blur of each band, px."""

MARGIN = 24
"""Border that does not count, px: pixels from outside the image have blurred into it."""

TUNING_CROP = 384
"""Side of the crops for tuning baselines, px."""
TUNING_PHOTOS = 12
"""Number of photos for tuning baselines."""

_PURPOSE_EVALUATION = 2
_PURPOSE_TUNING = 3
_PURPOSE_MEAN_KERNEL = 4


@dataclass(frozen=True)
class RestorationCase:
    """A photo (sRGB [H, W, 3] in [0, 1]), its blurred version and the blur kernel."""

    source: str
    sharp: ImageF32
    blurred: ImageF32
    kernel: Kernel


Method = Callable[[RestorationCase], ImageF32]


def psnr(image: ImageF32, reference: ImageF32) -> float:
    """Return the PSNR in dB of sRGB images in [0, 1], without the border; infinite for equal images."""
    inner = slice(MARGIN, -MARGIN)
    error = image[inner, inner].astype(np.float64) - reference[inner, inner]
    mean = float(np.mean(np.square(error)))
    return float("inf") if mean == 0.0 else -10.0 * np.log10(mean)


def unsharp_mask(image: ImageF32, sigma: float, amount: float) -> ImageF32:
    """Add ``amount`` times the difference to a Gaussian blur of ``sigma`` px."""
    smooth = cv2.GaussianBlur(image, (0, 0), sigma)
    return np.clip(image + np.float32(amount) * (image - smooth), 0.0, 1.0)


def wiener(image: ImageF32, kernel: Kernel, noise_to_signal: float) -> ImageF32:
    """Apply Wiener deconvolution in linear light: spectrum * conj(K) / (|K|² + noise_to_signal)."""
    reach = 2 * kernel.shape[0]
    padded = np.pad(linear_from_srgb(image), ((reach, reach), (reach, reach), (0, 0)), mode="reflect")
    shape = padded.shape[:2]
    centred = np.zeros(shape)
    centred[: kernel.shape[0], : kernel.shape[1]] = kernel
    centred = np.roll(centred, (-(kernel.shape[0] // 2), -(kernel.shape[1] // 2)), axis=(0, 1))
    spectrum = np.fft.rfft2(centred)
    inverse = np.conj(spectrum) / (np.abs(spectrum) ** 2 + noise_to_signal)
    restored = np.fft.irfft2(np.fft.rfft2(padded, axes=(0, 1)) * inverse[..., None], s=shape, axes=(0, 1))
    inner = np.clip(restored[reach:-reach, reach:-reach], 0.0, 1.0).astype(np.float32)
    return srgb_from_linear(inner)


def mean_kernel(band: tuple[int, int], seed: int) -> Kernel:
    """Return the mean of 400 random motion kernels of a band."""
    rng = np.random.default_rng([seed, _PURPOSE_MEAN_KERNEL, band[0]])
    side = 4 * band[1] + 1
    total = np.zeros((side, side))
    for _ in range(400):
        kernel = motion_kernel(rng, rng.uniform(*band))
        first = (side - kernel.shape[0]) // 2
        total[first : first + kernel.shape[0], first : first + kernel.shape[0]] += kernel
    used = np.flatnonzero(total.sum(axis=0))
    inner = slice(used[0], used[-1] + 1)
    mean = total[inner, inner]
    return np.asarray(mean / mean.sum(), np.float32)


def make_cases(
    photos: Sequence[Path], band: tuple[int, int] | None, *, crop: int | None, seed: int, purpose: int
) -> list[RestorationCase]:
    """Make one case per photo.

    Args:
        photos: Photo files.
        band: Shortest and longest blur, px; None for sharp cases.
        crop: Side of the central square to use, px; None for the whole photo.
        seed: Seed of blur and noise.
        purpose: Second seed, so that uses of one seed differ.
    """
    cases = []
    for index, path in enumerate(photos):
        rng = np.random.default_rng([seed, purpose, index, band[0] if band else 0])
        photo = read_photo(path)
        if crop is not None:
            y, x = (max(0, (extent - crop) // 2) for extent in photo.shape[:2])
            photo = photo[y : y + crop, x : x + crop]
        sharp = photo.astype(np.float32) / np.float32(255.0)
        if band is None:
            cases.append(RestorationCase(source_of(path), sharp, sharp, IDENTITY))
            continue
        kernel = motion_kernel(rng, rng.uniform(*band))
        blurred = degrade(sharp, Degradation(kernel=kernel, noise=rng.uniform(0.0, 1.0) / 255.0), rng)
        cases.append(RestorationCase(source_of(path), sharp, blurred, kernel))
    return cases


def score(method: Method, cases: Iterable[RestorationCase]) -> NDArray[np.float64]:
    """Return the PSNR in dB of the method's result on each case."""
    return np.array([psnr(method(case), case.sharp) for case in cases])


def _best(candidates: Sequence[Method], cases: Sequence[RestorationCase]) -> Method:
    return max(candidates, key=lambda method: float(score(method, cases).mean()))


def tuned_baselines(photos: Sequence[Path], band: tuple[int, int], seed: int) -> dict[str, Method]:
    """Return unsharp masking and both Wiener filters with the best settings on training photos."""
    chosen = photos[:: max(1, len(photos) // TUNING_PHOTOS)][:TUNING_PHOTOS]
    cases = make_cases(chosen, band, crop=TUNING_CROP, seed=seed, purpose=_PURPOSE_TUNING)
    average = mean_kernel(band, seed)
    ratios = np.geomspace(1e-4, 3.0, 10)

    def unsharp(sigma: float, amount: float) -> Method:
        return lambda case: unsharp_mask(case.blurred, sigma, amount)

    def blind(ratio: float) -> Method:
        return lambda case: wiener(case.blurred, average, ratio)

    def oracle(ratio: float) -> Method:
        return lambda case: wiener(case.blurred, case.kernel, ratio)

    grid = itertools.product((1.0, 2.0, 3.0, 5.0, 8.0), (0.1, 0.25, 0.5, 0.75, 1.0, 1.5))
    return {
        "unsharp masking": _best([unsharp(sigma, amount) for sigma, amount in grid], cases),
        "Wiener, mean kernel of the band": _best([blind(ratio) for ratio in ratios], cases),
        "(Wiener, true kernel)": _best([oracle(ratio) for ratio in ratios], cases),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Measure restoration experts on held-out photo sources.")
    parser.add_argument("--photos", type=Path, required=True)
    parser.add_argument(
        "--expert", action="append", help="embedded (default) or an ONNX file; may be repeated"
    )
    parser.add_argument("--crop", type=int, help="side of a central square crop, px; default: whole photos")
    parser.add_argument("--every", type=int, default=1, help="use every n-th photo")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    held_out = list_photos(options.photos, held_out=True)[:: options.every]
    training = list_photos(options.photos, held_out=False)

    spent: dict[str, float] = {}

    def expert_method(spec: str) -> Method:
        expert = load_expert(spec)

        def restore(case: RestorationCase) -> ImageF32:
            started = time.perf_counter()
            restored = expert.restore(case.blurred, threads=options.threads)
            spent[spec] = spent.get(spec, 0.0) + time.perf_counter() - started
            return restored

        return restore

    experts = {spec: expert_method(spec) for spec in options.expert or ["embedded"]}
    columns: list[tuple[str, list[RestorationCase], dict[str, Method]]] = []
    for band in BANDS:
        cases = make_cases(held_out, band, crop=options.crop, seed=options.seed, purpose=_PURPOSE_EVALUATION)
        columns.append((f"{band[0]}-{band[1]} px", cases, tuned_baselines(training, band, options.seed)))
    sharp = make_cases(held_out, None, crop=options.crop, seed=options.seed, purpose=_PURPOSE_EVALUATION)

    rows: dict[str, list[str]] = {}
    details: list[str] = []
    for title, cases, baselines in columns:
        before = score(lambda case: case.blurred, cases)
        rows.setdefault("blurred input", []).append(f"{before.mean():.2f}")
        for name, method in (baselines | experts).items():
            after = score(method, cases)
            rows.setdefault(name, []).append(f"{after.mean():.2f} ({(after - before).mean():+.2f})")
            if name in experts:
                gain = after - before
                sources = np.array([case.source for case in cases])
                parts = ", ".join(f"{s} {gain[sources == s].mean():+.2f}" for s in sorted(set(sources)))
                count = f"{int((gain > 0).sum())} of {len(gain)} photos"
                details.append(f"* {name}, {title}: better on {count}, worst {gain.min():+.2f} dB; {parts}")
    for name, method in experts.items():
        left = score(method, sharp)
        rows[name].append(f"{left.mean():.2f} (worst {left.min():.2f})")

    print(f"PSNR in dB (gain), mean over {len(held_out)} photos\n")
    print("| | " + " | ".join(title for title, _, _ in columns) + " | sharp input |")
    print("|---|" + "---|" * (len(columns) + 1))
    for name, cells in rows.items():
        print(f"| {name} | " + " | ".join(cells + [""] * (len(columns) + 1 - len(cells))) + " |")
    print("\n" + "\n".join(details))
    pixels = sum(case.sharp[..., 0].size for _, cases, _ in columns for case in cases)
    pixels += sum(case.sharp[..., 0].size for case in sharp)
    for name, seconds in spent.items():
        print(f"* {name}: {seconds / pixels * 1e6:.1f} s per megapixel, {options.threads} thread(s)")


if __name__ == "__main__":
    main()
