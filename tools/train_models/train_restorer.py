"""Train the restoration expert of ClearGS: its network, its training and its export.

    python -m tools.train_models.train_restorer --photos DIR --renders DIR --out restorer.onnx

trains on the photos DIR/*.jpg without held-out sources (a source is the file name up to the first ``_``), on
sharp renders (DIR/*/truth/observed/images of `cleargs synth`) and on drawn shapes. Then it writes the ONNX
model. An interrupted training resumes from its checkpoint; a finished one is only exported. The export needs
the package ``onnx``. `evaluate_restorer` prints the table for the held-out sources.

The time of the default recipe is in ``cleargs/models/weights/README.md``.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from cleargs.errors import InputError
from cleargs.types import ImageF32, ImageU8
from tools.train_models.degrade import degrade, handheld_degradation, shallow_focus
from tools.train_models.graphics import graphic
from tools.train_models.muon import Muon

HELD_OUT = ("budgie", "elementary", "mate")
"""Photo sources that no training uses."""

STRIDE = 8
"""Image sides must be multiples of this."""

PATCH = 128
"""Side of a training patch, px."""
MARGIN = 20
"""Border around a patch, px. It provides true neighbours for the blur, instead of reflections."""

RENDERED_SHARE, DRAWN_SHARE = 0.3, 0.1
"""Shares of renders and of drawn shapes among the patches. Their edges are perfectly sharp, unlike those of
most photos."""
SHRUNK_SHARE, MAX_SHRINK = 0.6, 3.0
"""Share of photo patches that are shrunk to make them sharper, and the largest factor."""

SHALLOW_SHARE = 0.25
"""Share of the patches whose truth is partly out of focus. The photos rarely have a shallow depth of field,
and without examples the network mistakes it for blur."""

BATCH = 8
LEARNING_RATE = 1e-3
WARM_UP = 300
DECAY_SHARE = 0.4
"""Share of the steps, at the end, in which the learning rate falls to zero along a half cosine."""

CLIP_NORM = 0.2
"""Maximum norm of the gradient."""
EMA_DECAY = 0.999
"""Decay of the running average of the weights."""
SPECTRUM_WEIGHT = 0.1
"""Weight of the spectra in the loss."""
CHECKPOINT_EVERY = 100

_PURPOSE_SAMPLES = 1


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions with a leaky ReLU between them, added to the input.

    It has no normalisation, which would make a pixel depend on its whole tile.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)
        for parameter in self.second.parameters():
            nn.init.zeros_(parameter)

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = x + self.second(functional.leaky_relu(self.first(x), 0.1))
        return out


def _blocks(channels: int, count: int) -> nn.Sequential:
    return nn.Sequential(*(ResidualBlock(channels) for _ in range(count)))


class Restorer(nn.Module):
    """Network from blurred to sharp sRGB images, [N, 3, H, W] in [0, 1], with sides divisible by `STRIDE`.

    A residual U-Net on pixel-unshuffled input at 1/2, 1/4 and 1/8 of the size, with similar cost per level.
    It predicts the difference to its input. It has no global pooling, so that neighbouring tiles agree.
    """

    def __init__(self, widths: Sequence[int] = (32, 64, 128), blocks: Sequence[int] = (1, 2, 4)) -> None:
        super().__init__()
        self.stem = nn.Conv2d(12, widths[0], 3, padding=1)
        self.encode_half = _blocks(widths[0], blocks[0])
        self.down_quarter = nn.Conv2d(widths[0], widths[1], 2, stride=2)
        self.encode_quarter = _blocks(widths[1], blocks[1])
        self.down_eighth = nn.Conv2d(widths[1], widths[2], 2, stride=2)
        self.middle = _blocks(widths[2], blocks[2])
        self.up_quarter = nn.Conv2d(widths[2], 4 * widths[1], 1)
        self.decode_quarter = _blocks(widths[1], blocks[1])
        self.up_half = nn.Conv2d(widths[1], 4 * widths[0], 1)
        self.decode_half = _blocks(widths[0], blocks[0])
        self.head = nn.Conv2d(widths[0], 12, 3, padding=1)
        for parameter in self.head.parameters():
            nn.init.zeros_(parameter)

    def forward(self, image: Tensor) -> Tensor:
        half = self.encode_half(self.stem(functional.pixel_unshuffle(image, 2)))
        quarter = self.encode_quarter(self.down_quarter(half))
        eighth = self.middle(self.down_eighth(quarter))
        quarter = self.decode_quarter(quarter + functional.pixel_shuffle(self.up_quarter(eighth), 2))
        half = self.decode_half(half + functional.pixel_shuffle(self.up_half(quarter), 2))
        return image + functional.pixel_shuffle(self.head(half), 2)


def source_of(photo: Path) -> str:
    """Return the source of a photo: its file name up to the first underscore."""
    return photo.stem.split("_")[0]


def list_photos(folder: Path, *, held_out: bool) -> list[Path]:
    """Return the sorted photos of a folder that belong to held-out sources, or all others.

    Raises:
        InputError: There is no such photo.
    """
    photos = [p for p in sorted(folder.glob("*.jpg")) if (source_of(p) in HELD_OUT) == held_out]
    if not photos:
        raise InputError(
            f"no {'held-out ' if held_out else ''}photos in {folder}",
            hint=f"give --photos a folder of SOURCE_NNN.jpg; held-out sources are {', '.join(HELD_OUT)}",
        )
    return photos


def read_photo(path: Path) -> ImageU8:
    """Read a photo as RGB uint8 [H, W, 3]; raise InputError if it cannot be decoded."""
    bgr = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if bgr is None:
        raise InputError(f"cannot decode {path}", hint="replace the file or remove it from the folder")
    return np.ascontiguousarray(bgr[..., ::-1], np.uint8)


def list_renders(folder: Path) -> list[Path]:
    """Return the sorted sharp views of all captures by `cleargs synth` in a folder.

    Raises:
        InputError: There is no such capture.
    """
    renders = sorted(folder.glob("*/truth/observed/images/*.png"))
    if not renders:
        raise InputError(f"no synthetic captures in {folder}", hint="make some with `cleargs synth`")
    return renders


@dataclass(frozen=True)
class Contents:
    """Images from which patches are cut: photos and renders, each RGB uint8 [H, W, 3]."""

    photos: Sequence[ImageU8]
    renders: Sequence[ImageU8]


def draw_sample(contents: Contents, rng: np.random.Generator) -> tuple[ImageF32, ImageF32]:
    """Return a degraded patch and its sharp truth, float32 sRGB [PATCH, PATCH, 3].

    Defocus is part of the truth (`SHALLOW_SHARE`).
    """
    kind = rng.random()
    if kind < DRAWN_SHARE:
        sharp = graphic(PATCH + 2 * MARGIN, rng)
    elif kind < DRAWN_SHARE + RENDERED_SHARE:
        sharp = _cut(contents.renders, 1.0, rng)
    else:
        shrunk = rng.random() < SHRUNK_SHARE
        sharp = _cut(contents.photos, rng.uniform(1.0, MAX_SHRINK) if shrunk else 1.0, rng)
    if rng.random() < SHALLOW_SHARE:
        sharp = shallow_focus(sharp, rng)
    blurred = degrade(sharp, handheld_degradation(rng), rng)
    inner = slice(MARGIN, MARGIN + PATCH)
    return blurred[inner, inner], sharp[inner, inner]


def _cut(images: Sequence[ImageU8], scale: float, rng: np.random.Generator) -> ImageF32:
    """Return a patch with margin, shrunk by ``scale``, rotated and mirrored at random.

    It is the one with more detail among the patches at two random places.
    """
    image = images[int(rng.integers(len(images)))]
    size = PATCH + 2 * MARGIN
    side = min(round(size * scale), *image.shape[:2])
    crops = []
    for _ in range(2):
        y, x = (int(rng.integers(extent - side + 1)) for extent in image.shape[:2])
        crops.append(image[y : y + side, x : x + side])
    crop = max(crops, key=lambda c: float(np.abs(np.diff(c[::2, :, 1].astype(np.int16), axis=1)).mean()))
    if side != size:
        crop = cv2.resize(crop, (size, size), interpolation=cv2.INTER_AREA).astype(np.uint8)
    crop = np.rot90(crop, int(rng.integers(4)))
    if rng.random() < 0.5:
        crop = crop[:, ::-1]
    return crop.astype(np.float32) / np.float32(255.0)


def draw_batch(contents: Contents, seed: int, step: int) -> tuple[Tensor, Tensor]:
    """Return the degraded and sharp batch [BATCH, 3, PATCH, PATCH]; it depends only on seed and step."""
    pairs = [
        draw_sample(contents, np.random.default_rng([seed, _PURPOSE_SAMPLES, step, index]))
        for index in range(BATCH)
    ]
    degraded, sharp = (
        torch.from_numpy(np.stack(side)).permute(0, 3, 1, 2) for side in zip(*pairs, strict=True)
    )
    return degraded, sharp


def restoration_loss(restored: Tensor, sharp: Tensor) -> Tensor:
    """Return the Charbonnier distance in sRGB plus a weighted L1 distance of spectra, to favour detail."""
    difference = restored - sharp
    pixels = torch.sqrt(difference.square() + 1e-6).mean()
    spectrum = torch.fft.rfft2(difference, norm="ortho").abs().mean()
    loss: Tensor = pixels + SPECTRUM_WEIGHT * spectrum
    return loss


def learning_rate(step: int, steps: int) -> float:
    """Return the learning rate: linear warm-up, plateau, then a half cosine over the last `DECAY_SHARE`."""
    if step < WARM_UP:
        return LEARNING_RATE * (step + 1) / WARM_UP
    done = (step - (1.0 - DECAY_SHARE) * steps) / (DECAY_SHARE * steps)
    return LEARNING_RATE * 0.5 * (1.0 + math.cos(math.pi * min(max(done, 0.0), 1.0)))


def train(
    contents: Contents, checkpoint: Path, *, steps: int, seed: int, bfloat16: bool, start: Path | None = None
) -> Restorer:
    """Train a restorer.

    Args:
        contents: Training images.
        checkpoint: File of the state; if it exists, the training resumes from it.
        steps: Total number of steps.
        seed: Seed of initial weights and patches.
        bfloat16: True to compute the network in bfloat16.
        start: Checkpoint of an earlier training whose averaged weights are the initial ones.

    Returns:
        The network with averaged weights, in evaluation mode.
    """
    torch.manual_seed(seed)
    model = Restorer()
    if start is not None:
        model.load_state_dict(torch.load(start, weights_only=True)["average"])
    average = Restorer()
    average.load_state_dict(model.state_dict())
    optimisers = _optimisers(model)
    first = 0
    if checkpoint.exists():
        state = torch.load(checkpoint, weights_only=True)
        model.load_state_dict(state["model"])
        average.load_state_dict(state["average"])
        for optimiser, saved in zip(optimisers, state["optimisers"], strict=True):
            optimiser.load_state_dict(saved)
        first = int(state["step"])
    started, window = time.monotonic(), 0.0
    for step in range(first, steps):
        degraded, sharp = draw_batch(contents, seed, step)
        for optimiser in optimisers:
            for group in optimiser.param_groups:
                group["lr"] = learning_rate(step, steps)
        with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
            restored = model(degraded.contiguous(memory_format=torch.channels_last))
        loss = restoration_loss(restored.float(), sharp)
        model.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        nn.utils.clip_grad_norm_(model.parameters(), CLIP_NORM)
        for optimiser in optimisers:
            optimiser.step()
        decay = min(EMA_DECAY, (step + 1) / (step + 10))
        with torch.no_grad():
            for mean, value in zip(average.parameters(), model.parameters(), strict=True):
                mean.lerp_(value, 1.0 - decay)
        window += loss.item()
        done = step + 1
        if done % CHECKPOINT_EVERY == 0 or done == steps:
            rate = (done - first) / (time.monotonic() - started)
            count = CHECKPOINT_EVERY if done % CHECKPOINT_EVERY == 0 else done % CHECKPOINT_EVERY
            print(
                f"step {done}/{steps}  loss {window / count:.5f}  {rate:.2f} it/s",
                file=sys.stderr,
                flush=True,
            )
            window = 0.0
            _save(checkpoint, done, model, average, optimisers)
    return average.eval()


def _optimisers(model: Restorer) -> list[torch.optim.Optimizer]:
    """Return Muon for the weights of hidden layers, and Adam for the first and last layer and all biases."""
    edge = {id(model.stem.weight), id(model.head.weight)}
    hidden = [p for p in model.parameters() if p.ndim == 4 and id(p) not in edge]
    others = [p for p in model.parameters() if p.ndim != 4 or id(p) in edge]
    return [Muon(hidden, LEARNING_RATE), torch.optim.Adam(others, LEARNING_RATE, betas=(0.9, 0.99))]


def _save(
    path: Path, step: int, model: Restorer, average: Restorer, optimisers: Sequence[torch.optim.Optimizer]
) -> None:
    part = path.with_suffix(path.suffix + ".part")
    torch.save(
        {
            "step": step,
            "model": model.state_dict(),
            "average": average.state_dict(),
            "optimisers": [optimiser.state_dict() for optimiser in optimisers],
        },
        part,
    )
    part.replace(path)


def export_onnx(model: Restorer, path: Path) -> None:
    """Write the network as ONNX: input ``image``, output ``restored``, float32 [N, 3, H, W] of any size."""
    axes = {0: "n", 2: "height", 3: "width"}
    torch.onnx.export(
        model,
        (torch.zeros(1, 3, 8 * STRIDE, 8 * STRIDE),),
        str(path),
        dynamo=False,
        opset_version=17,
        input_names=["image"],
        output_names=["restored"],
        dynamic_axes={"image": axes, "restored": axes},
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Train and export from the command line."""
    parser = argparse.ArgumentParser(description="Train and export the restoration expert.")
    parser.add_argument("--photos", type=Path, required=True, help="folder of sharp photos SOURCE_NNN.jpg")
    parser.add_argument(
        "--renders", type=Path, required=True, help="folder of captures made by `cleargs synth`"
    )
    parser.add_argument("--start", type=Path, help="checkpoint of a training with the initial weights")
    parser.add_argument("--out", type=Path, required=True, help="the ONNX file to write")
    parser.add_argument("--checkpoint", type=Path, help="default: name of the ONNX file with .pt")
    parser.add_argument("--steps", type=int, default=6400)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument(
        "--float32", action="store_true", help="do not use bfloat16 (for CPUs without AVX512-BF16)"
    )
    options = parser.parse_args(arguments)
    if importlib.util.find_spec("onnx") is None:
        raise SystemExit("the export needs the package onnx: pip install onnx")
    torch.set_num_threads(options.threads)
    cv2.setNumThreads(1)
    checkpoint = options.checkpoint or options.out.with_suffix(".pt")
    contents = Contents(
        [read_photo(p) for p in list_photos(options.photos, held_out=False)],
        [read_photo(p) for p in list_renders(options.renders)],
    )
    model = train(
        contents,
        checkpoint,
        steps=options.steps,
        seed=options.seed,
        bfloat16=not options.float32,
        start=options.start,
    )
    export_onnx(model, options.out)


if __name__ == "__main__":
    main()
