"""A GPU that cannot be used is refused with a reason and a remedy."""

from __future__ import annotations

import importlib

import pytest
import torch

from cleargs.errors import InputError
from cleargs.gpu import Machine
from cleargs.manifest import KeyParts
from cleargs.pipeline.keys import key_config, library_versions
from cleargs.pipeline.session import resolve_device
from cleargs.splat.backend import rasteriser_for
from cleargs.splat.kernels.cuda import support


def test_engine_refuses_a_gpu_that_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError) as caught:
        rasteriser_for("cuda")
    assert "--device cpu" in caught.value.hint
    monkeypatch.setattr(support.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="Triton") as caught:
        rasteriser_for("cuda")
    assert "cleargs[cuda]" in caught.value.hint
    with pytest.raises(InputError, match="no meta back end"):
        rasteriser_for("meta")


def test_the_command_line_names_the_obstacle() -> None:
    machine = Machine(lambda: "there is no NVIDIA GPU")
    with pytest.raises(InputError, match="no NVIDIA GPU") as caught:
        resolve_device("cuda", lambda line: None, machine=machine)
    assert "--device cpu" in caught.value.hint


@pytest.mark.parametrize("stage", ["g0", "rivr", "consolidate"])
def test_the_device_is_part_of_the_key(stage: str) -> None:
    module = importlib.import_module(f"cleargs.stages.{stage}")
    parts = KeyParts(
        stage=stage,
        version=module.VERSION,
        config=key_config(module.CONFIG()),
        inputs={},
        externals={},
        seed=0,
        device="cpu",
        libraries=library_versions(module, "cpu", module.CONFIG()),
    )
    assert parts.key != parts.model_copy(update={"device": "cuda"}).key
