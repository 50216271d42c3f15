"""Convert MUSIQ and CLIP-IQA from their published weights, with the implementations of pyiqa.

Modules of pyiqa are imported individually: the whole package also imports dependencies of its training.
"""

from __future__ import annotations

import io
import pickle
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor, nn
from torch.export import Dim

from cleargs.errors import InputError
from cleargs.models.scorer import PATCH
from tools.convert_models.torch_export import declare_torchvision_operators, export, first_line


def convert(kind: str, checkpoint: bytes, path: Path) -> None:
    """Write the scorer ``musiq`` or ``clip-iqa`` as ONNX; raise InputError if the weights do not fit."""
    declare_torchvision_operators()
    try:
        _CONVERTERS[kind](checkpoint, path)
    except (pickle.UnpicklingError, RuntimeError, KeyError, EOFError) as error:
        raise InputError(
            f"these are not the weights of {kind}: {first_line(error)}",
            hint="give the unchanged file from its authors",
        ) from error


class MusiqNetwork(nn.Module):
    """pyiqa's MUSIQ without preprocessing: patches of one image -> mean opinion score."""

    def __init__(self, musiq: Any) -> None:
        super().__init__()
        self.stem = nn.Sequential(musiq.conv_root, musiq.gn_root, musiq.root_pool, musiq.block1)
        self.embedding = musiq.embedding
        self.encoder = musiq.transformer_encoder
        self.head = musiq.head

    def forward(
        self,
        patches: Tensor,  # [N, 3, 32, 32] in [-1, 1]
        places: Tensor,  # [N] cells of the position grid
        scales: Tensor,  # [N] indices of the image sizes
    ) -> Tensor:
        """Return the score [1, 1]."""
        tokens = self.embedding(self.stem(patches).permute(0, 2, 3, 1).flatten(1))[None]
        every = torch.ones_like(places, dtype=tokens.dtype)[None]
        score: Tensor = self.head(self.encoder(tokens, places[None], scales[None], every)[:, 0])
        return score


class ClipIqaNetwork(nn.Module):
    """pyiqa's CLIP-IQA with precomputed features of its constant prompts."""

    mean: Tensor
    deviation: Tensor
    prompts: Tensor

    def __init__(self, clip_iqa: Any) -> None:
        super().__init__()
        clip = clip_iqa.clip_model[0].float()
        self.visual = clip.visual
        self.register_buffer("mean", clip_iqa.default_mean)
        self.register_buffer("deviation", clip_iqa.default_std)
        with torch.no_grad():
            prompts = clip.encode_text(clip_iqa.prompt_pairs)
            prompts = prompts / prompts.norm(dim=-1, keepdim=True) * clip.logit_scale.exp()
        self.register_buffer("prompts", prompts)

    def forward(
        self,
        image: Tensor,  # [1, 3, H, W] sRGB in [0, 1]
    ) -> Tensor:
        """Return 100 x the mean probability of the positive prompt of each pair [1, 1]."""
        features = self.visual((image - self.mean) / self.deviation, pos_embedding=False)
        features = features / features.norm(dim=-1, keepdim=True)
        pairs = (features @ self.prompts.t()).reshape(1, -1, 2).softmax(dim=-1)
        score: Tensor = 100.0 * pairs[..., 0].mean(dim=1, keepdim=True)
        return score


def _musiq(checkpoint: bytes, path: Path) -> None:
    from pyiqa.archs.arch_util import clean_state_dict
    from pyiqa.archs.musiq_arch import MUSIQ

    musiq = MUSIQ(pretrained=False)
    state = torch.load(io.BytesIO(checkpoint), map_location="cpu", weights_only=True)
    musiq.load_state_dict(clean_state_dict(state), strict=True)
    network = MusiqNetwork(musiq).eval().requires_grad_(False)
    count = Dim("patches", min=2)
    numbers = torch.zeros(5, dtype=torch.long)
    export(
        network,
        (torch.zeros(5, 3, PATCH, PATCH), numbers, numbers.clone()),
        path,
        inputs=("patches", "places", "scales"),
        output="score",
        free=({0: count}, {0: count}, {0: count}),
    )


def _clip_iqa(checkpoint: bytes, path: Path) -> None:
    from pyiqa.archs.clipiqa_arch import CLIPIQA

    with tempfile.NamedTemporaryFile(suffix=".pt") as file:
        file.write(checkpoint)
        file.flush()
        clip_iqa = CLIPIQA(backbone=file.name)  # a file is loaded; a name would be downloaded
    network = ClipIqaNetwork(clip_iqa).eval().requires_grad_(False)
    free = {2: Dim("height", min=32), 3: Dim("width", min=32)}
    export(network, (torch.rand(1, 3, 160, 224),), path, inputs=("image",), output="score", free=(free,))


_CONVERTERS: Mapping[str, Callable[[bytes, Path], None]] = MappingProxyType(
    {"musiq": _musiq, "clip-iqa": _clip_iqa}
)
