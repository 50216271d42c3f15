"""Train the learned no-reference scorer, which predicts LPIPS to the clean image from the degraded one.

    python -m tools.train_models.train_scorer --photos DIR --work DIR --out scorer.onnx

The target is LPIPS v0.1 with AlexNet, the variant that its authors recommend as a metric. VGG takes fifteen
times as long and is more sensitive to tone, but not to detail. The script needs the LPIPS weights (`cleargs
models install lpips`), and the packages onnx and onnxscript for the export. It is seeded and uses one thread
by default.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Iterator
from pathlib import Path

import click
import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import spearmanr
from torch import Tensor, nn
from torch.nn import functional

from cleargs.models.lpips import load_lpips
from tools.train_models.scorer_pairs import KIND_NAMES, PATCH, Pairs, make_pairs
from tools.train_models.train_restorer import HELD_OUT, source_of

_GROUPS_PER_BATCH = 8
_VERSIONS_PER_GROUP = 4  # versions per group in a batch
_KIND_WEIGHTS = {
    "oversharp": 2.0,
    "ringing": 2.0,
}  # shown more often, because they look sharper than the clean version
_TOLERANCE = 0.003  # degraded versions with a smaller difference of LPIPS have no required order
_CLEAN_ORDER_WEIGHT = 3.0  # weight of the order of the clean and another version, even if the two are close
_TEMPERATURE = 0.03  # temperature of the logistic losses, in LPIPS


class QualityNet(nn.Module):
    """Network that predicts LPIPS to the clean version, [N], from sRGB images [N, 3, H, W] in [0, 1].

    LPIPS compares feature vectors of unit length, so local brightness and contrast have little effect on it.
    The same holds for this network. Its inputs are luminance normalised in a fine and a coarse window, chroma
    relative to the local contrast, and the logarithm of that contrast. Four strided convolutions follow. A
    small perceptron gets the mean and deviation of each stage's channels.
    """

    colour: Tensor

    def __init__(self, widths: tuple[int, ...] = (24, 48, 96, 128), hidden: int = 96) -> None:
        super().__init__()
        bt601 = [[0.299, 0.587, 0.114], [-0.169, -0.331, 0.5], [0.5, -0.419, -0.081]]
        self.register_buffer("colour", torch.tensor(bt601).view(3, 3, 1, 1))
        stages = []
        channels = 5
        for index, width in enumerate(widths):
            kernel = 5 if index == 0 else 3
            layers: list[nn.Module] = [
                nn.Conv2d(channels, width, kernel, stride=2, padding=kernel // 2, bias=False),
                nn.BatchNorm2d(width),
                nn.ReLU(),
            ]
            if index >= 2:
                layers.append(_Residual(width))
            stages.append(nn.Sequential(*layers))
            channels = width
        self.stages = nn.ModuleList(stages)
        self.head = nn.Sequential(
            nn.Dropout(0.2), nn.Linear(2 * sum(widths), hidden), nn.ReLU(), nn.Linear(hidden, 1)
        )

    def forward(self, images: Tensor) -> Tensor:
        return self.distance(self.statistics(images))

    def distance(self, statistics: Tensor) -> Tensor:
        """Return predicted LPIPS [N], at least 0, from statistics [N, F]."""
        return functional.softplus(self.head(statistics)[:, 0] - 1.5)

    def statistics(self, images: Tensor) -> Tensor:
        """Return mean and deviation of each stage's channels [N, F]."""
        x = self._normalised(images)
        statistics = []
        for stage in self.stages:
            x = stage(x)
            centre = x.mean(dim=(2, 3))
            spread = ((x - centre[:, :, None, None]).square().mean(dim=(2, 3)) + 1e-6).sqrt()
            statistics += [centre, spread]
        return torch.cat(statistics, dim=1)

    def _normalised(self, images: Tensor) -> Tensor:
        ycc = functional.conv2d(images, self.colour)
        luma, squared = ycc[:, :1], ycc[:, :1].square()
        fine, coarse = _box(ycc, 7), _box(luma, 25)
        fine_contrast = _deviation(squared, fine[:, :1], 7)
        coarse_contrast = _deviation(squared, coarse, 25)
        high = (ycc - fine) / (fine_contrast + 0.01)
        return torch.cat(
            [high, (luma - coarse) / (coarse_contrast + 0.01), 0.5 * fine_contrast.log() + 2.0], dim=1
        )


class _Residual(nn.Module):
    """Depthwise 3x3 and pointwise convolution, added to the input."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(width, width, 3, padding=1, groups=width, bias=False),
            nn.Conv2d(width, width, 1, bias=False),
            nn.BatchNorm2d(width),
        )

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(x + self.body(x))


def _box(x: Tensor, side: int) -> Tensor:
    """Return the mean over a square window; two 1D passes take a tenth of the time for the coarse one."""
    rows = functional.avg_pool2d(x, (side, 1), stride=1, padding=(side // 2, 0), count_include_pad=False)
    return functional.avg_pool2d(rows, (1, side), stride=1, padding=(0, side // 2), count_include_pad=False)


def _deviation(squared: Tensor, mean: Tensor, side: int) -> Tensor:
    return (_box(squared, side) - mean.square()).clamp_min(0.0).add(1e-5).sqrt()


def train(
    pairs: Pairs,
    *,
    seconds: float,
    epochs: int,
    seed: int,
    checkpoint: Path,
    start: Path | None = None,
    rate: float = 2e-3,
    head_only: bool = False,
) -> QualityNet:
    """Train with AdamW and a one-cycle learning rate.

    Args:
        pairs: Training pairs.
        seconds: Time limit. The learning rate follows the time if the limit comes before ``epochs``.
        epochs: Maximum number of epochs.
        seed: Seed of initial weights and batches.
        checkpoint: File to which the averaged weights are saved regularly.
        start: Checkpoint with initial weights; its training starts a new cycle of the learning rate.
        rate: Peak learning rate.
        head_only: True to keep the convolutions unchanged.

    Returns:
        The network with averaged weights, in evaluation mode.
    """
    torch.manual_seed(seed)
    net = QualityNet()
    if start is not None:
        net.load_state_dict(torch.load(start, weights_only=True))
    average = copy.deepcopy(net)
    if head_only:
        net.stages.eval().requires_grad_(False)
    trained = [p for p in net.parameters() if p.requires_grad]
    optimiser = torch.optim.AdamW(trained, lr=1.0, weight_decay=0.03)
    steps = epochs * (len(pairs.images) // _GROUPS_PER_BATCH)
    begin = time.monotonic()
    for step, batch in enumerate(_batches(pairs, epochs, seed)):
        progress = max(step / steps, (time.monotonic() - begin) / seconds)
        if progress >= 1.0:
            break
        for group in optimiser.param_groups:
            group["lr"] = rate * _cycle(progress)
        images, targets = batch
        loss = _loss(net(images.flatten(0, 1)).view_as(targets), targets)
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        optimiser.step()
        _update_average(average, net, decay=min(0.995, (step + 1) / (step + 10)))
        if step % 100 == 0:
            click.echo(f"{progress:6.1%}  step {step}  loss {loss.item():.4f}", err=True)
            torch.save(average.state_dict(), checkpoint)
    torch.save(average.state_dict(), checkpoint)
    return average.eval()


def _cycle(progress: float) -> float:
    warm = min(1.0, progress / 0.05)
    return float(warm * 0.5 * (1.0 + np.cos(np.pi * progress)) + 1e-3)


def _loss(
    predicted: Tensor,  # [G, V]
    targets: Tensor,  # [G, V]
) -> Tensor:
    """Return a smooth L1 loss plus two logistic losses on the order of pairs.

    One is over pairs of versions of one content, the other over all pairs of the batch, weighted by the
    difference of their targets.
    """
    regression = functional.smooth_l1_loss(predicted, targets, beta=0.05)
    within = (targets[:, :, None] - targets[:, None, :] > _TOLERANCE).float()
    within[:, 1:, 0] = _CLEAN_ORDER_WEIGHT
    across = (targets.reshape(-1, 1) - targets.reshape(1, -1)).clamp_min(0.0)
    return (
        4.0 * regression + 0.5 * _disorder(predicted, within) + 2.0 * _disorder(predicted.flatten(), across)
    )


def _disorder(
    predicted: Tensor,  # [..., V]
    weights: Tensor,  # [..., V, V] importance that the first is above the second
) -> Tensor:
    gap = predicted[..., :, None] - predicted[..., None, :]
    return (functional.softplus(-gap / _TEMPERATURE) * weights).sum() / weights.sum().clamp_min(1e-6)


def _batches(pairs: Pairs, epochs: int, seed: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield batches of groups in random order and orientation: the clean version and some others of each."""
    versions = pairs.targets.shape[1]
    weights = np.array([_KIND_WEIGHTS.get(name, 1.0) for name in KIND_NAMES])
    for epoch in range(epochs):
        rng = np.random.default_rng([seed, epoch])
        order = rng.permutation(len(pairs.images))
        for start in range(0, len(order) - _GROUPS_PER_BATCH + 1, _GROUPS_PER_BATCH):
            chosen = order[start : start + _GROUPS_PER_BATCH, None]
            # Hard kinds are drawn more often (exponential races with weights as rates).
            races = (
                rng.exponential(size=(_GROUPS_PER_BATCH, versions - 1))
                / weights[pairs.kinds[chosen[:, 0], 1:]]
            )
            shown = np.argsort(races, axis=1)[:, : _VERSIONS_PER_GROUP - 1] + 1
            shown = np.concatenate([np.zeros_like(shown[:, :1]), shown], axis=1)
            images = torch.from_numpy(pairs.images[chosen, shown]).permute(0, 1, 4, 2, 3).float() / 255.0
            if rng.random() < 0.5:
                images = images.flip(-1)
            if rng.random() < 0.5:
                images = images.flip(-2)
            if rng.random() < 0.5:
                images = images.transpose(-1, -2)
            yield images.contiguous(), torch.from_numpy(pairs.targets[chosen, shown])


def _update_average(average: nn.Module, net: nn.Module, decay: float) -> None:
    with torch.no_grad():
        for kept, new in zip(average.state_dict().values(), net.state_dict().values(), strict=True):
            if kept.dtype.is_floating_point:
                kept.lerp_(new, 1.0 - decay)
            else:
                kept.copy_(new)


def predict(net: QualityNet, pairs: Pairs) -> NDArray[np.float32]:
    """Return the predicted LPIPS of every version [G, V]."""
    with torch.inference_mode():
        rows = [
            net(torch.from_numpy(np.array(g)).permute(0, 3, 1, 2).float() / 255.0).numpy()
            for g in pairs.images
        ]
    return np.stack(rows)


def report(predicted: NDArray[np.float32], pairs: Pairs) -> list[str]:
    """Return a Markdown table by kind: rank agreement with LPIPS, share of correctly ranked clean versions.

    ``predicted`` [G, V] is lower for better versions.
    """
    lines = [
        f"Spearman over all patches {spearman(predicted, pairs.targets):.3f}",
        "Spearman within one content (mean) "
        + f"{np.mean([spearman(p, t) for p, t in zip(predicted, pairs.targets, strict=True)]):.3f}",
        "",
        "| degradation | patches | mean LPIPS | Spearman | clean ranked first |",
        "|---|---|---|---|---|",
    ]
    clean = np.broadcast_to(predicted[:, :1], predicted.shape)
    for index, name in enumerate(KIND_NAMES[1:], start=1):
        chosen = pairs.kinds == index
        wins = float((predicted[chosen] > clean[chosen]).mean())
        lines.append(
            f"| {name} | {chosen.sum()} | {pairs.targets[chosen].mean():.3f} "
            f"| {spearman(predicted[chosen], pairs.targets[chosen]):.3f} | {wins:.1%} |"
        )
    return lines


def spearman(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    """Return Spearman's rank correlation of all elements."""
    return float(spearmanr(a.ravel(), b.ravel()).statistic)


class _Score(nn.Module):
    """The network with its output scaled as in tables: 100 - 100 x predicted LPIPS."""

    def __init__(self, net: QualityNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, images: Tensor) -> Tensor:
        distance: Tensor = self.net(images)
        return 100.0 - 100.0 * distance


def export(net: QualityNet, path: Path) -> None:
    """Write the scorer as ONNX: input `image` [N, 3, H, W] sRGB in [0, 1], output `score` [N]; H, W >= 32."""
    torch.onnx.export(
        _Score(net).eval(),
        (torch.rand(2, 3, PATCH, PATCH + 32),),
        str(path),
        input_names=["image"],
        output_names=["score"],
        dynamic_axes={"image": {0: "n", 2: "h", 3: "w"}, "score": {0: "n"}},
        opset_version=17,
        dynamo=False,
    )


@click.command()
@click.option("--photos", type=click.Path(exists=True, file_okay=False, path_type=Path), required=True)
@click.option(
    "--work", type=click.Path(file_okay=False, path_type=Path), required=True, help="Folder for the pairs."
)
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), required=True)
@click.option(
    "--hold-out",
    multiple=True,
    default=HELD_OUT,
    show_default=True,
    help="Held-out photo sources (file prefixes).",
)
@click.option("--contents", default=16, show_default=True, help="Patches per training photo.")
@click.option("--versions", default=8, show_default=True, help="Versions per patch, the clean one included.")
@click.option(
    "--start",
    type=click.Path(exists=True, path_type=Path),
    default=None,
    help="Checkpoint with initial weights.",
)
@click.option("--rate", default=2e-3, show_default=True, help="Peak learning rate.")
@click.option("--head-only", is_flag=True, help="Train only the perceptron.")
@click.option("--graphics", default=0.25, show_default=True, help="Share of drawn images among the contents.")
@click.option("--epochs", default=6, show_default=True)
@click.option("--minutes", default=60.0, show_default=True, help="Time limit of the training.")
@click.option("--threads", default=1, show_default=True)
@click.option("--seed", default=1, show_default=True)
@click.option("--models", type=click.Path(path_type=Path), default=None, help="Folder of installed models.")
def main(
    photos: Path,
    work: Path,
    out: Path,
    hold_out: tuple[str, ...],
    contents: int,
    versions: int,
    start: Path | None,
    rate: float,
    head_only: bool,
    graphics: float,
    epochs: int,
    minutes: float,
    threads: int,
    seed: int,
    models: Path | None,
) -> None:
    """Make the pairs, train, print a report on the held-out photo sources, and export."""
    torch.set_num_threads(threads)
    cv2.setNumThreads(1)
    lpips = load_lpips("alex", models)
    files = sorted(photos.glob("*.jpg"))
    unseen = [p for p in files if source_of(p) in hold_out]
    seen = [p for p in files if p not in unseen]
    test = make_pairs(unseen, lpips, work / "held", contents=5, versions=None, seed=seed + 1000)
    pairs = make_pairs(
        seen, lpips, work / "train", contents=contents, versions=versions, seed=seed, graphics=graphics
    )
    net = train(
        pairs,
        seconds=60.0 * minutes,
        epochs=epochs,
        seed=seed,
        checkpoint=work / "scorer.pt",
        start=start,
        rate=rate,
        head_only=head_only,
    )
    click.echo("\n".join(report(predict(net, test), test)))
    export(net, out)
    click.echo(
        f"{out}: {out.stat().st_size} bytes, {sum(p.numel() for p in net.parameters())} weights", err=True
    )


if __name__ == "__main__":
    main()
