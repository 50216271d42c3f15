"""The restoration expert ClearGS ships: its network, its training and its export.

    python -m tools.train_models.train_restorer --photos DIR --renders DIR --out restorer.onnx

trains on the photographs DIR/*.jpg whose source (file name up to the first ``_``) is not held out, on sharp
renders (DIR/*/truth/observed/images of `cleargs synth`) and on drawn shapes, and writes the ONNX model. A
killed run resumes from its checkpoint; a finished one only exports. The export needs the ``onnx`` package.
`evaluate_restorer` prints the table of the held-out sources.

Cost of the default recipe: see ``cleargs/models/weights/README.md``.
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
"""Photo sources that training never sees."""

STRIDE = 8
"""Image sides must be multiples of this."""

PATCH = 128
MARGIN = 20
"""Pixels around a patch that only the blur sees: its borders are then true neighbours, not reflections."""

RENDERED_SHARE, DRAWN_SHARE = 0.3, 0.1
"""Shares of the patches that are not photographs but renders, and drawn shapes: their edges are as sharp as
the pixels allow, which those of photographs rarely are."""
SHRUNK_SHARE, MAX_SHRINK = 0.6, 3.0
"""Share of the photographs' patches that are shrunk, and the largest factor: it makes them crisper."""

SHALLOW_SHARE = 0.25
"""Share of the patches that are put out of focus before they count as the truth: the photographs hardly have
any shallow depth of field, and a network that never saw it takes it for blur."""

BATCH = 8
LEARNING_RATE = 1e-3
WARM_UP = 300
DECAY_SHARE = 0.4
"""The last part of the steps over which the learning rate falls to zero along a half cosine."""

CLIP_NORM = 0.2
EMA_DECAY = 0.999
SPECTRUM_WEIGHT = 0.1
CHECKPOINT_EVERY = 100

_PURPOSE_SAMPLES = 1


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions around a leaky ReLU, added to the input.

    No normalisation: it would make a pixel depend on its whole tile.
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
    """Blurred sRGB image to sharp one, [N, 3, H, W] in [0, 1], sides multiples of `STRIDE`.

    A residual U-Net on pixel-unshuffled input at 1/2, 1/4 and 1/8 of the size, every level at similar cost;
    it predicts the difference to its input. It sees only a neighbourhood
    (no global pooling), so that tiles agree.
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
    """The source of a photograph: its file name up to the first underscore."""
    return photo.stem.split("_")[0]


def list_photos(folder: Path, *, held_out: bool) -> list[Path]:
    """The photographs of a folder, sorted: those of the held-out sources, or all others.

    Raises InputError when there is none.
    """
    photos = [p for p in sorted(folder.glob("*.jpg")) if (source_of(p) in HELD_OUT) == held_out]
    if not photos:
        raise InputError(
            f"no {'held-out ' if held_out else ''}photographs in {folder}",
            hint=f"--photos names a folder of SOURCE_NNN.jpg; held-out sources are {', '.join(HELD_OUT)}",
        )
    return photos


def read_photo(path: Path) -> ImageU8:
    """A photograph as [H, W, 3] RGB uint8. Raises InputError when it cannot be decoded."""
    bgr = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if bgr is None:
        raise InputError(f"cannot decode {path}", hint="replace the file or take it out of the folder")
    return np.ascontiguousarray(bgr[..., ::-1], np.uint8)


def list_renders(folder: Path) -> list[Path]:
    """The sharp views of the captures made by `cleargs synth` in a folder, sorted.

    Raises InputError when there is none.
    """
    renders = sorted(folder.glob("*/truth/observed/images/*.png"))
    if not renders:
        raise InputError(f"no synthetic captures in {folder}", hint="make some with `cleargs synth`")
    return renders


@dataclass(frozen=True)
class Contents:
    """What the patches are cut from: photographs and renders, each [H, W, 3] RGB uint8."""

    photos: Sequence[ImageU8]
    renders: Sequence[ImageU8]


def draw_sample(contents: Contents, rng: np.random.Generator) -> tuple[ImageF32, ImageF32]:
    """One degraded patch and its sharp truth: [PATCH, PATCH, 3] each. Defocus is part of the truth
    (`SHALLOW_SHARE`).
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
    """A patch with its margin, shrunk by ``scale``, turned and mirrored; of two random places that with more
    detail.
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
    """The degraded and sharp batch [BATCH, 3, PATCH, PATCH] of a step, a function of seed and step alone."""
    pairs = [
        draw_sample(contents, np.random.default_rng([seed, _PURPOSE_SAMPLES, step, index]))
        for index in range(BATCH)
    ]
    degraded, sharp = (
        torch.from_numpy(np.stack(side)).permute(0, 3, 1, 2) for side in zip(*pairs, strict=True)
    )
    return degraded, sharp


def restoration_loss(restored: Tensor, sharp: Tensor) -> Tensor:
    """Charbonnier distance in sRGB plus a weighted L1 distance of the spectra, which asks for detail."""
    difference = restored - sharp
    pixels = torch.sqrt(difference.square() + 1e-6).mean()
    spectrum = torch.fft.rfft2(difference, norm="ortho").abs().mean()
    loss: Tensor = pixels + SPECTRUM_WEIGHT * spectrum
    return loss


def learning_rate(step: int, steps: int) -> float:
    """Linear warm-up, a plateau, and a half cosine down to zero over the last `DECAY_SHARE` of the steps."""
    if step < WARM_UP:
        return LEARNING_RATE * (step + 1) / WARM_UP
    done = (step - (1.0 - DECAY_SHARE) * steps) / (DECAY_SHARE * steps)
    return LEARNING_RATE * 0.5 * (1.0 + math.cos(math.pi * min(max(done, 0.0), 1.0)))


def train(
    contents: Contents, checkpoint: Path, *, steps: int, seed: int, bfloat16: bool, start: Path | None = None
) -> Restorer:
    """Train from the checkpoint, where there is one, up to ``steps``; return the averaged network.

    ``start``: the checkpoint of an earlier training whose averaged weights are the first ones of this.
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
    """Muon for the weights between the hidden layers, Adam for the first and last layer and all biases."""
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
    """Write the network as ONNX: ``image`` in, ``restored`` out, [N, 3, H, W] float32, sizes free."""
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
    """The command line of the recipe."""
    parser = argparse.ArgumentParser(description="Train and export the restoration expert.")
    parser.add_argument(
        "--photos", type=Path, required=True, help="folder of sharp photographs SOURCE_NNN.jpg"
    )
    parser.add_argument(
        "--renders", type=Path, required=True, help="folder of captures made by `cleargs synth`"
    )
    parser.add_argument("--start", type=Path, help="checkpoint of a training whose weights come first")
    parser.add_argument("--out", type=Path, required=True, help="the ONNX file to write")
    parser.add_argument("--checkpoint", type=Path, help="default: the ONNX file's name with .pt")
    parser.add_argument("--steps", type=int, default=6400)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument(
        "--float32", action="store_true", help="no bfloat16 arithmetic (for CPUs without AVX512-BF16)"
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
