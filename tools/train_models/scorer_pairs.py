"""Training pairs for the learned scorer: versions of one content, with LPIPS to the clean version.

They are made once and stored on disk, because LPIPS takes longer than a training step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from cleargs.media.colour import linear_from_srgb, srgb_from_linear
from cleargs.models.lpips import LpipsNetwork
from cleargs.types import ImageF32
from tools.train_models.artefacts import KINDS, patches
from tools.train_models.degrade import convolve, disc_kernel
from tools.train_models.graphics import graphic

PATCH = 128  # side of a training patch and of the tiles over which the scorer averages, px
_MARGIN = 24  # border that is degraded with the patch and then cut off, so that no filter shows its border
KIND_NAMES: tuple[str, ...] = tuple(KINDS)
_KIND_WEIGHTS = {
    "oversharp": 5.0,
    "ringing": 4.0,
}  # hard kinds are more frequent: they look sharper than the clean version


@dataclass(frozen=True)
class Pairs:
    """G groups of V versions of one content; version 0 is the clean one."""

    images: NDArray[np.uint8]  # [G, V, PATCH, PATCH, 3] sRGB
    targets: NDArray[np.float32]  # [G, V] LPIPS to version 0
    kinds: NDArray[np.int8]  # [G, V] indices into KIND_NAMES


def make_pairs(
    photos: Sequence[Path],
    lpips: LpipsNetwork,
    folder: Path,
    *,
    contents: int,
    versions: int | None,
    seed: int,
    graphics: float = 0.0,
) -> Pairs:
    """Cut random patches from photos and degrade each of them.

    Finished groups in ``folder`` are kept, so that an interrupted call can be resumed.

    Args:
        photos: Photo files.
        lpips: The metric of the targets.
        folder: Folder of the arrays.
        contents: Patches per photo.
        versions: For training, number of versions per patch, the clean one included. Kinds are drawn with
            repetition, and the look of the content varies. None, for tests, makes every kind once and keeps
            the look.
        seed: Seed of all random choices.
        graphics: Share of contents that are drawn instead of cut from photos.
    """
    folder.mkdir(parents=True, exist_ok=True)
    names = [p for _ in range(contents) for p in photos]
    count, width = len(names), versions or len(KIND_NAMES)
    images = _array(folder / "images.npy", (count, width, PATCH, PATCH, 3), np.uint8)
    targets = _array(folder / "targets.npy", (count, width), np.float32)
    kinds = _array(folder / "kinds.npy", (count, width), np.int8)
    done = _array(folder / "done.npy", (count,), np.bool_)
    for group, photo in enumerate(names):
        if done[group]:
            continue
        rng = np.random.default_rng([seed, group])
        chosen = _choose(rng, versions)
        drawn = graphics > 0.0 and rng.random() < graphics
        content = graphic(PATCH + 2 * _MARGIN, rng) if drawn else _content(photo, rng)
        if versions is not None:
            content = _vary(content, rng)
        stack = [_inner(KINDS[KIND_NAMES[k]](content, rng)) for k in chosen]
        images[group] = np.round(np.stack(stack) * 255.0).astype(np.uint8)
        targets[group] = _distances(images[group], lpips)
        kinds[group] = chosen
        done[group] = True
    return Pairs(images, targets, kinds)


def load_pairs(folder: Path) -> Pairs:
    """Return the pairs in ``folder`` from `make_pairs`, memory-mapped."""
    images, targets, kinds = (
        np.load(folder / f"{name}.npy", mmap_mode="r") for name in ("images", "targets", "kinds")
    )
    return Pairs(images, targets, kinds)


def _choose(rng: np.random.Generator, versions: int | None) -> NDArray[np.int64]:
    if versions is None:
        return np.arange(len(KIND_NAMES))
    weights = np.array([_KIND_WEIGHTS.get(name, 1.0) for name in KIND_NAMES[1:]])
    drawn = rng.choice(len(weights), versions - 1, p=weights / weights.sum())
    return np.concatenate([[0], 1 + drawn])


def _content(photo: Path, rng: np.random.Generator) -> ImageF32:
    """Cut a patch with margin from a photo, reduced by a random factor, which also hides its JPEG grid."""
    image = cv2.imread(str(photo), cv2.IMREAD_COLOR)
    assert image is not None, photo
    side = PATCH + 2 * _MARGIN
    smallest = (side + 1) / min(image.shape[:2])
    factor = float(np.exp(rng.uniform(np.log(max(0.33, smallest)), np.log(0.95))))
    image = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    patch = image[:side, :side]
    for _ in range(8):  # avoids patches without texture, such as sky
        top, left = (int(rng.integers(0, n - side + 1)) for n in image.shape[:2])
        patch = image[top : top + side, left : left + side]
        if patch.std() > 12.0:
            break
    return np.ascontiguousarray(patch[..., ::-1].astype(np.float32) / np.float32(255.0))


def _vary(image: ImageF32, rng: np.random.Generator) -> ImageF32:
    """Vary colours, exposure and contrast of an image, and often defocus a part of it.

    The few photo sources are similar in these respects. Without this, the network learns the look of a source
    and mistakes the soft background of a close-up, a sky or a plain wall for an artefact.
    """
    out = image[..., rng.permutation(3)]
    grey = out.mean(axis=2, keepdims=True)
    out = grey + rng.uniform(0.0, 1.2) * (out - grey)
    out = np.clip(out, 0.0, 1.0) ** np.exp(rng.normal(0.0, 0.35))
    contrast = np.exp(rng.uniform(np.log(0.12), 0.0))
    out = (contrast * out + rng.uniform(0.0, 1.0 - contrast)).astype(np.float32)
    kind = rng.random()
    if kind < 0.5:
        radius = rng.uniform(1.0, 5.0) if kind < 0.3 else rng.uniform(3.0, 16.0)
        soft = convolve(linear_from_srgb(out), disc_kernel(radius))
        share = patches(out.shape[0], out.shape[1], rng) if kind < 0.3 else np.float32(rng.uniform(0.8, 1.0))
        out = out + share * (srgb_from_linear(np.clip(soft, 0.0, 1.0)) - out)
    return np.asarray(out, np.float32)


def _inner(image: ImageF32) -> ImageF32:
    return image[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN]


def _distances(group: NDArray[np.uint8], lpips: LpipsNetwork) -> NDArray[np.float32]:
    batch = torch.from_numpy(group).permute(0, 3, 1, 2).float() / 255.0
    with torch.inference_mode():
        features = lpips.features(batch)
        layers = [
            head((f - f[:1]).square()).mean(dim=(1, 2, 3))
            for f, head in zip(features, lpips.heads, strict=True)
        ]
        return torch.stack(layers).sum(dim=0).numpy()


def _array(path: Path, shape: tuple[int, ...], dtype: type[np.generic]) -> np.memmap:
    if path.exists():
        existing = np.lib.format.open_memmap(path, mode="r+")
        if existing.shape == shape and existing.dtype == dtype:
            return existing
    return np.lib.format.open_memmap(path, mode="w+", dtype=dtype, shape=shape)
