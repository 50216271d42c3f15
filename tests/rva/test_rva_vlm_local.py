"""Qwen3-VL in process: the whole stage with a tiny random model of the real architecture."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from vlm_server import FRAMES, two_stages

from cleargs.cli.main import invoke
from cleargs.parquet import read_table
from cleargs.rva.tables import CUE_COLUMNS
from cleargs.rva.tables import FRAMES as TABLE

transformers = pytest.importorskip("transformers", reason="the extra vlm (transformers) is not installed")
pytest.importorskip("llguidance", reason="the extra vlm (llguidance) is not installed")

SPECIAL = (
    *("<|endoftext|>", "<|im_start|>", "<|im_end|>", "<|vision_start|>", "<|vision_end|>"),
    *("<|image_pad|>", "<|video_pad|>"),
)


def make_model(folder: Path) -> None:
    """Write a Qwen3-VL with two layers and a tokenizer of bytes, with the files of a released model."""
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers
    from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil

    letters = sorted(pre_tokenizers.ByteLevel.alphabet())
    bytes_only = Tokenizer(models.BPE(vocab={letter: k for k, letter in enumerate(letters)}, merges=[]))
    bytes_only.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    bytes_only.decoder = decoders.ByteLevel()
    tokenizer = transformers.PreTrainedTokenizerFast(
        tokenizer_object=bytes_only,
        eos_token="<|im_end|>",
        pad_token="<|endoftext|>",
        additional_special_tokens=list(SPECIAL),
    )
    tokenizer.save_pretrained(folder)
    sizes = {"hidden_size": 32, "intermediate_size": 64}
    text: dict[str, Any] = {
        **sizes,
        "vocab_size": 320,  # more than the tokenizer's, as in released models
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
        "num_key_value_heads": 1,
        "head_dim": 16,
        "initializer_range": 0.3,  # large enough that the image changes the reply
        "rope_parameters": {
            "rope_type": "default",
            "rope_theta": 1e4,
            "mrope_section": [4, 2, 2],
            "mrope_interleaved": True,
        },
    }
    vision: dict[str, Any] = {
        **sizes,
        "depth": 2,
        "num_heads": 2,
        "out_hidden_size": 32,
        "num_position_embeddings": 64,
        "deepstack_visual_indexes": [0],
        "initializer_range": 0.3,
    }
    ids = {name: tokenizer.convert_tokens_to_ids(name) for name in SPECIAL}
    config = transformers.Qwen3VLConfig(
        text_config=text,
        vision_config=vision,
        image_token_id=ids["<|image_pad|>"],
        video_token_id=ids["<|video_pad|>"],
        vision_start_token_id=ids["<|vision_start|>"],
        vision_end_token_id=ids["<|vision_end|>"],
    )
    with torch.random.fork_rng():
        torch.manual_seed(0)
        transformers.Qwen3VLForConditionalGeneration(config).save_pretrained(folder)
    Qwen2VLImageProcessorPil(
        patch_size=16,
        size={"shortest_edge": 1024, "longest_edge": 65536},
        image_mean=[0.5] * 3,
        image_std=[0.5] * 3,
    ).save_pretrained(folder)


@pytest.fixture(scope="module")
def model_dir(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("models") / "tiny-qwen3-vl"
    make_model(folder)
    yield folder


def run(folder: Path, model_dir: Path, *settings: str) -> int:
    (folder / "source").mkdir(parents=True, exist_ok=True)
    recipe = folder / "empty.toml"
    recipe.touch()
    given = ["run", str(folder / "source"), "-o", str(folder / "run"), "--workflow", str(recipe)]
    for setting in ("evaluator=qwen3-vl", f"qwen.model_dir={model_dir}", "qwen.local_threads=1", *settings):
        given += ["--set", f"rva.{setting}"]
    return invoke([*given, "--device", "cpu"], two_stages())


def table(folder: Path) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = read_table(folder / "run" / "rva" / "frames.parquet", TABLE).to_pylist()
    return rows


def test_a_random_model_fills_the_table(model_dir: Path, tmp_path: Path) -> None:
    assert run(tmp_path / "a", model_dir) == 0
    rows = table(tmp_path / "a")
    assert len(rows) == FRAMES
    assert {row["evaluator"] for row in rows} == {"qwen3-vl:tiny-qwen3-vl:prompt-1"}
    steps = {round(0.05 * k, 2) for k in range(21)}
    assert {row[column] for row in rows for column in CUE_COLUMNS} <= steps
    assert all(row["role"] and row["weight"] is not None for row in rows)
    assert run(tmp_path / "b", model_dir) == 0
    assert table(tmp_path / "b") == rows


def test_the_weights_are_part_of_the_key(
    model_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import shutil

    copy = tmp_path / "tiny-qwen3-vl"
    shutil.copytree(model_dir, copy)
    assert run(tmp_path / "a", model_dir) == 0
    capsys.readouterr()
    assert run(tmp_path / "a", copy) == 0
    assert "reused: ingest, rva" in capsys.readouterr().out, "the same model elsewhere"
    config = copy / "generation_config.json"
    config.write_text(config.read_text() + "\n")
    assert run(tmp_path / "a", copy) == 0
    assert "(rva " in capsys.readouterr().out


def test_a_truncated_reply_is_not_a_score(
    model_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(tmp_path, model_dir, "qwen.max_tokens=64") == 1
    assert "scored no frame: the reply is invalid" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["nothing", "another architecture"])
def test_folders_without_such_a_model(
    model_dir: Path, tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other"
    other.mkdir()
    if kind == "another architecture":
        transformers.GPT2Config(n_layer=1, n_embd=8, n_head=1).save_pretrained(other)
    assert run(tmp_path, other) == 2
    shown = capsys.readouterr().err
    assert "cannot load a Qwen3-VL model" in shown and "Traceback" not in shown
