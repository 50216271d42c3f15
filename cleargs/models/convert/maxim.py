"""MAXIM-3S (Tu et al., CVPR 2022), trained for deblurring on GoPro, from its TensorFlow.js release.

The network has three stages, of which each ends in a supervised output: the restored image. Cut after an
earlier one, it is cheaper: on blur of 13-19 px, the first stage has 3.2 of the 4.0 dB that all three gain, at
a quarter of the cost.
"""

from __future__ import annotations

import io
import tarfile
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from cleargs.models.convert.expression import Expression
from cleargs.models.convert.fuse import fused
from cleargs.models.convert.onnx_file import write_onnx
from cleargs.models.convert.tfjs import read_model, translate

TILE = 256
"""Side of the images it was trained on and is run on; a multiple of 64."""

_BACKBONE = "StatefulPartitionedCall/jax2tf_apply_/Wrapper/backbone"
_RESTORED: Mapping[int, str] = MappingProxyType(
    {
        1: f"{_BACKBONE}/stage_0_supervised_attention_module_0/jit_fn_/AddV2",
        2: f"{_BACKBONE}/stage_1_supervised_attention_module_0/jit_fn_/AddV2",
        3: "Identity",
    }
)


def convert(archive: bytes, stage: int, path: Path, tile: int = TILE) -> None:
    """Write the network up to the output of ``stage`` (1 to 3) as ONNX.

    archive: the npm package, a .tgz. Input ``image`` and output ``restored`` are [1, tile, tile, 3] float32
    sRGB in [0, 1], the output not clipped. Raises ValueError if the archive holds another network.
    """
    restored = fused(network(archive, stage, tile))
    metadata = {"source": "MAXIM-3S, GoPro deblurring", "stage": str(stage)}
    write_onnx(path, restored, input_name="image", output_name="restored", metadata=metadata)


def network(archive: bytes, stage: int, tile: int = TILE) -> Expression:
    """The network up to the output of ``stage``, as TensorFlow spells it."""
    with tarfile.open(fileobj=io.BytesIO(archive), mode="r:gz") as package:

        def read(name: str) -> bytes:
            file = package.extractfile(f"package/models/{name}")
            if file is None:
                raise ValueError(f"{name} is not a file")
            return file.read()

        nodes, weights = read_model(read)
    return translate(nodes, weights, _RESTORED[stage], (1, tile, tile, 3))
