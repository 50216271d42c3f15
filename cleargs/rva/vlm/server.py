"""Qwen3-VL behind a server: the conversation about one picture."""

from __future__ import annotations

import json
from typing import Any

from cleargs.rva.arrays import Floats
from cleargs.rva.config import QwenConfig
from cleargs.rva.vlm.chat import ChatClient, RefusedError, UnreachableError
from cleargs.rva.vlm.picture import Picture, UnscoredError
from cleargs.rva.vlm.prompt import ReplyError, parse_reply, prompt_text, reply_schema

_REPEATED = 2000  # characters of a faulty reply that the model is shown again


class ServerPictureScorer:
    """Asks a server for scores; see `PictureScorer`."""

    def __init__(self, config: QwenConfig, *, seed: int) -> None:
        """Raises InputError when the server's address or key cannot be used."""
        self.model = config.model
        self.workers = config.concurrency
        self.identity = json.dumps(["server", config.model, config.max_tokens, seed])
        self._asks = config.asks
        self._request = {
            "model": config.model,
            "temperature": 0,
            "seed": seed % 2**31,  # servers hold it in 32 bits
            "max_tokens": config.max_tokens,
        }
        self._client = ChatClient(config)
        self._takes_schema = True
        self._gone: str | None = None

    def stop(self) -> None:
        """See `PictureScorer.stop`."""
        self._client.stop()

    def score(self, picture: Picture) -> Floats:
        """See `PictureScorer.score`. A reply outside the schema is answered with what is wrong with it."""
        if self._gone is not None:
            raise UnscoredError(self._gone)
        messages: list[dict[str, Any]] = [
            {
                "role": "user",
                "content": [
                    {"type": "image_url", "image_url": {"url": picture.data_url()}},
                    {"type": "text", "text": prompt_text(masked=picture.masked)},
                ],
            }
        ]
        fault = ""
        for _ in range(self._asks):
            reply = self._reply(messages)
            try:
                return parse_reply(reply)
            except ReplyError as error:
                fault = str(error)
            complaint = f"This reply cannot be used: {fault}. Answer again with the JSON object alone."
            messages = [
                messages[0],
                {"role": "assistant", "content": reply[:_REPEATED]},
                {"role": "user", "content": complaint},
            ]
        raise UnscoredError(f"the last of {self._asks} replies cannot be used: {fault}")

    def _reply(self, messages: list[dict[str, Any]]) -> str:
        """The model's text; by the schema where the server knows how to force it, else as it comes."""
        chat = {**self._request, "messages": messages}
        try:
            if self._takes_schema:
                try:
                    return self._client.complete({**chat, "response_format": _RESPONSE_FORMAT})
                except RefusedError:
                    # The server does not take the format, or the picture: ask without the former.
                    reply = self._client.complete(chat)
                    self._takes_schema = False
                    return reply
            return self._client.complete(chat)
        except UnreachableError as error:
            self._gone = str(error)  # the other frames need not wait for the same end
            raise


_RESPONSE_FORMAT = {
    "type": "json_schema",
    "json_schema": {"name": "cues", "strict": True, "schema": reply_schema()},
}
