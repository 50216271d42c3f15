"""Measure the conversions at full size, and the cost of all available models.

A conversion is measured with the published architecture and random weights: time, memory, and the largest
difference to PyTorch. Conversions and installed models::

  .venv-convert/bin/python -m tools.convert_models.full_size restormer nafnet musiq clip-iqa
  .venv/bin/python -m tools.convert_models.full_size embedded clarity-net lpips ...

Each model is measured in a separate process on one thread. Times are processor seconds. docs/models.md shows
the results.
"""

from __future__ import annotations

import io
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import nn

SIZE = (540, 960)
"""Rows and columns of the image for times and memory."""


def image(height: int, width: int) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Return smooth noise of several scales [H, W, 3], sRGB in [0, 1]."""
    rng = np.random.default_rng([height, width])
    planes = [
        nn.functional.interpolate(
            torch.from_numpy(rng.random((1, 3, height // s + 1, width // s + 1), np.float32)),
            size=(height, width),
            mode="bilinear",
        )
        for s in (1, 4, 16)
    ]
    mean = torch.stack(planes).sum(dim=0)[0] / 3
    return np.ascontiguousarray(mean.permute(1, 2, 0).numpy())


def peak_gb() -> float:
    """Return the peak memory of this process, GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def checkpoint(network: nn.Module) -> bytes:
    """Return the weights of a network as a checkpoint file."""
    buffer = io.BytesIO()
    torch.save(network.state_dict(), buffer)
    return buffer.getvalue()


def random_network(name: str) -> Any:
    """Return the published architecture with random weights, such that the network changes the image."""
    from tools.convert_models.torch_export import declare_torchvision_operators

    declare_torchvision_operators()
    torch.manual_seed(0)
    if name == "restormer":
        from spandrel_extra_arches.architectures.Restormer.__arch.restormer_arch import Restormer

        return Restormer().eval()  # the motion deblurring model: dim 48, blocks 4 6 6 8, 4 of refinement
    if name == "nafnet":
        from spandrel.architectures.NAFNet.__arch.NAFNet_arch import NAFNet

        network = NAFNet(width=64, middle_blk_num=1, enc_blk_nums=[1, 1, 1, 28], dec_blk_nums=[1, 1, 1, 1])
        for label, weights in network.named_parameters():
            if label.endswith(("beta", "gamma")):
                nn.init.normal_(weights, std=0.1)
        return network.eval()
    if name == "musiq":
        from pyiqa.archs.musiq_arch import MUSIQ

        return MUSIQ(pretrained=False).eval()
    from pyiqa.archs import clip_model

    # CLIP's RN50: images of 224 px, layers 3 4 6 3 of width 64; 77 tokens of text, width 512, 12 layers
    clip = clip_model.CLIP(1024, 224, (3, 4, 6, 3), 64, 0, 77, 49408, 512, 8, 12).eval()
    for weights in clip.visual.parameters():
        if not weights.any():
            nn.init.normal_(weights, std=0.3)
    return clip


def convert(name: str, path: Path) -> dict[str, Any]:
    """Convert the random network to ``path`` and compare it with PyTorch."""
    from cleargs.models.expert import OnnxExpert
    from cleargs.models.scorer import LearnedScorer, MusiqScorer, Scorer
    from tools.convert_models import restorer, scorers

    network, start = random_network(name), time.process_time()
    tile = image(256, 256)
    if name in ("restormer", "nafnet"):
        restorer.convert(checkpoint(network), path)
        took, held = time.process_time() - start, peak_gb()
        with torch.no_grad():
            expected = network(torch.from_numpy(tile).permute(2, 0, 1)[None])[0].permute(1, 2, 0).numpy()
        found: Any = OnnxExpert(path).restore(tile)
        expected, scale = expected.clip(0, 1), float(np.abs(expected.clip(0, 1) - tile).max())
    else:
        if name == "musiq":
            scorers.convert("musiq", checkpoint(network), path)
            reference, scorer, factor = network, cast(Scorer, MusiqScorer(path)), 1.0
        else:
            from pyiqa.archs import clipiqa_arch

            clipiqa_arch.load = lambda backbone, device: network  # avoids a download of CLIP
            scorers.convert("clip-iqa", b"", path)
            reference, scorer, factor = clipiqa_arch.CLIPIQA().eval(), LearnedScorer(path), 100.0
        took, held = time.process_time() - start, peak_gb()
        sizes = [(270, 480), (200, 90), (64, 300), (256, 256)]
        with torch.no_grad():
            expected = np.array(
                [
                    factor * reference(torch.from_numpy(image(*size)).permute(2, 0, 1)[None]).item()
                    for size in sizes
                ]
            )
        found = np.array([scorer.score(image(*size)) for size in sizes])
        scale = float(np.ptp(expected))
    return {
        "parameters_m": sum(weights.numel() for weights in network.parameters()) / 1e6,
        "onnx_mb": path.stat().st_size / 1e6,
        "conversion_s": took,
        "conversion_gb": held,
        "largest_difference": float(np.abs(found - expected).max()),
        "what_the_network_changes": scale,
    }


def cost(name: str, path: Path | None) -> dict[str, Any]:
    """Return seconds per megapixel and memory of a model on one thread; ``path`` is a converted network."""
    from cleargs.models.expert import OnnxExpert, load_expert
    from cleargs.models.lpips import load_lpips
    from cleargs.models.scorer import LearnedScorer, MusiqScorer, load_scorer

    before, shown = peak_gb(), image(*SIZE)
    if name in ("restormer", "nafnet"):
        assert path is not None
        work: Any = OnnxExpert(path).restore
    elif name in ("musiq", "clip-iqa"):
        assert path is not None
        work = (MusiqScorer(path) if name == "musiq" else LearnedScorer(path)).score
    elif name.startswith("lpips"):
        metric = load_lpips("vgg" if name == "lpips-vgg" else "alex")

        def work(one: Any) -> Any:
            return metric.distance(one, one[::-1].copy())

    else:
        work = load_expert(name).restore if name == "embedded" else load_scorer(name).score
    first = image(256, 256)
    work(first)
    start = time.process_time()
    work(shown)
    seconds = time.process_time() - start
    return {"seconds_a_megapixel": seconds / (SIZE[0] * SIZE[1] / 1e6), "memory_gb": peak_gb() - before}


def main(names: list[str]) -> None:
    """Measure each model in a child process and print a line of JSON."""
    if len(names) == 3 and names[0] in ("--convert", "--cost"):
        torch.set_num_threads(1)
        path = Path(names[2])
        print(json.dumps(convert(names[1], path) if names[0] == "--convert" else cost(names[1], path)))
        return
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            path = Path(folder) / f"{name}.onnx"
            figures: dict[str, Any] = {"model": name}
            kinds = (
                ["--cost"]
                if name not in ("restormer", "nafnet", "musiq", "clip-iqa")
                else ["--convert", "--cost"]
            )
            for kind in kinds:
                command = [sys.executable, "-m", "tools.convert_models.full_size", kind, name, str(path)]
                figures |= json.loads(
                    subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout.splitlines()[-1]
                )
            print(
                json.dumps({k: v if isinstance(v, str) else float(f"{v:.3g}") for k, v in figures.items()}),
                flush=True,
            )


if __name__ == "__main__":
    main(sys.argv[1:])
