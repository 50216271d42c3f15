"""Qwen3-VL in this process, with transformers. Decoding is constrained to the schema token by token.

The model's processor class is not used, since it loads a video processor, which requires torchvision. The
image processor (the variant for Pillow) and the tokenizer give the same inputs.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from cleargs.errors import InputError
from cleargs.rva.config import QwenConfig
from cleargs.rva.vlm.evaluator import EncodedImage, QwenEvaluator, UnscoredError
from cleargs.rva.vlm.prompt import ReplyError, parse_reply, prompt_text, reply_schema
from cleargs.types import ArrayF64

_IMAGE = "<|image_pad|>"
_ARCHITECTURES = ("qwen3_vl", "qwen3_vl_moe")


class QwenFolder(QwenEvaluator):
    """Runs the model of a local folder. The model is loaded when the first image is scored."""

    def __init__(self, config: QwenConfig, *, device: Literal["cpu", "cuda"], cache: Path | None) -> None:
        """Identify the model in the cache by the names, sizes and times of its files."""
        self._folder = Path(config.model_dir).expanduser().absolute()
        self._device = device
        files = sorted(path for path in self._folder.rglob("*") if path.is_file())
        facts = [(path.name, stat.st_size, stat.st_mtime_ns) for path in files for stat in [path.stat()]]
        identity = json.dumps(["local", device, config.local_threads, config.max_tokens, facts])
        super().__init__(config, model=self._folder.name, identity=identity, cache=cache)

    def check(self) -> None:
        """Check the extra and the folder without reading weights.

        Raises InputError if the extra is not installed, or if the folder is not that of a Qwen3-VL model.
        """
        try:
            import llguidance.hf  # noqa: F401
            from transformers import AutoConfig
        except ImportError as error:
            raise InputError(
                f"the libraries for a local qwen3-vl cannot be loaded: {error.msg}",
                hint="pip install 'cleargs[vlm]'",
            ) from error
        with self._load_errors():
            kind = AutoConfig.from_pretrained(self._folder, local_files_only=True).model_type
            if kind not in _ARCHITECTURES:
                raise ValueError(f"its architecture is {kind}, not one of {', '.join(_ARCHITECTURES)}")

    @contextmanager
    def _load_errors(self) -> Iterator[None]:
        try:
            yield
        except (OSError, ValueError, KeyError) as error:
            raise InputError(
                f"cannot load a Qwen3-VL model from {self._folder}: {str(error).splitlines()[0]}",
                hint="set rva.qwen.model_dir to the folder with config.json, the weights and the tokenizer",
            ) from error

    @cached_property
    def _loaded(self) -> tuple[Any, Any, Any, Any]:
        """The model, its tokenizer, its image processor, and the matcher of the schema.

        Raises InputError as `check`, or if the weights cannot be loaded.
        """
        self.check()
        import llguidance
        import llguidance.hf
        from transformers import AutoModelForImageTextToText, AutoTokenizer
        from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil
        from transformers.utils.logging import disable_progress_bar

        disable_progress_bar()
        with self._load_errors():
            tokenizer = AutoTokenizer.from_pretrained(self._folder, local_files_only=True)
            images = Qwen2VLImageProcessorPil.from_pretrained(self._folder, local_files_only=True)
            model = AutoModelForImageTextToText.from_pretrained(
                self._folder, local_files_only=True, dtype="auto"
            )
        n_vocab = model.config.get_text_config().vocab_size
        vocabulary = llguidance.hf.from_tokenizer(tokenizer, n_vocab=n_vocab)
        grammar = llguidance.LLMatcher.grammar_from_json_schema(
            reply_schema(), defaults={"whitespace_flexible": False}
        )
        matcher = llguidance.LLMatcher(vocabulary, grammar)
        return model.to(self._device).eval(), tokenizer, images, matcher

    def score(self, image: EncodedImage) -> ArrayF64:
        """Return the cues of one image, by greedy decoding; see `QwenEvaluator.score`."""
        threads = torch.get_num_threads()
        torch.set_num_threads(self._config.local_threads)
        try:
            text = self._reply(image)
        finally:
            torch.set_num_threads(threads)
        try:
            return parse_reply(text)
        except ReplyError as fault:  # a reply cut off at max_tokens
            raise UnscoredError(f"the reply is invalid: {fault}") from None

    def _reply(self, image: EncodedImage) -> str:
        """Return the reply to the prompt. It is a valid object unless it reaches ``max_tokens``."""
        model, tokenizer, images, matcher = self._loaded
        seen = images(images=[image.rgb], return_tensors="pt")
        pads = int(seen["image_grid_thw"].prod()) // images.merge_size**2
        chat = (
            f"<|im_start|>user\n<|vision_start|>{_IMAGE * pads}<|vision_end|>"
            f"{prompt_text(masked=image.masked)}<|im_end|>\n<|im_start|>assistant\n"
        )
        ids = tokenizer(chat, return_tensors="pt", add_special_tokens=False)["input_ids"].to(model.device)
        matcher.reset()
        with torch.inference_mode():
            written = model.generate(
                input_ids=ids,
                attention_mask=torch.ones_like(ids),
                mm_token_type_ids=(ids == tokenizer.convert_tokens_to_ids(_IMAGE)).int(),
                pixel_values=seen["pixel_values"].to(model.device, model.dtype),
                image_grid_thw=seen["image_grid_thw"].to(model.device),
                logits_processor=[_SchemaMask(matcher, ids.shape[1])],
                max_new_tokens=self._config.max_tokens,
                eos_token_id=tokenizer.eos_token_id,
                pad_token_id=tokenizer.eos_token_id,
                do_sample=False,
                temperature=None,
                top_p=None,
                top_k=None,
            )
        return str(tokenizer.decode(written[0, ids.shape[1] :], skip_special_tokens=True))


class _SchemaMask:
    """A logits processor of transformers that allows only tokens with which the reply matches the schema.

    The masking kernel of llguidance uses torch.compile and so requires a C++ compiler. This one does not.
    """

    def __init__(self, matcher: Any, prompt_length: int) -> None:
        self._matcher = matcher
        self._consumed = prompt_length

    def __call__(self, input_ids: torch.Tensor, scores: torch.Tensor) -> torch.Tensor:  # [1, T], [1, V]
        self._matcher.consume_tokens(input_ids[0, self._consumed :].tolist())
        self._consumed = input_ids.shape[1]
        bits = np.frombuffer(self._matcher.compute_bitmask(), np.uint8)
        allowed = np.unpackbits(bits, bitorder="little", count=scores.shape[1]).astype(bool)
        return scores.masked_fill(torch.from_numpy(~allowed).to(scores.device), float("-inf"))
