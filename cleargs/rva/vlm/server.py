"""Qwen3-VL behind an OpenAI-compatible server: the conversation about one picture.

Each request is tried again while the server is busy, fails or is silent.

No redirects are followed (they would carry the key to another host), no proxy stands before a server on this
machine, and no text of an error holds the key.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from pathlib import Path
from threading import Event
from typing import Any

import httpx2

from cleargs.errors import InputError, StageError
from cleargs.rva.config import QwenConfig, check_base_url
from cleargs.rva.vlm.evaluator import EncodedImage, QwenEvaluator, UnscoredError
from cleargs.rva.vlm.prompt import ReplyError, parse_reply, prompt_text, reply_schema
from cleargs.types import ArrayF64

URL_VARIABLE = "CLEARGS_VLM_URL"
KEY_VARIABLE = "CLEARGS_VLM_API_KEY"
DEFAULT_URL = "http://127.0.0.1:8000/v1"

_BUSY = frozenset({408, 409, 425, 429, 500, 502, 503, 504, 529})
_NO_REPLY = (ValueError, LookupError, TypeError, RecursionError)
_MAX_PAUSE_S = 120.0  # s; also what a server may ask for with Retry-After
_MAX_REPLY_BYTES = 4 << 20  # bytes
_MAX_CHECK_S = 10.0  # s to wait for the list of models
_SHOWN = 200  # characters of a server's own words
_REPEATED = 2000  # characters of a faulty reply that the model is shown again
_KEY_HINT = f"put the server's key into {KEY_VARIABLE} of the environment"


_RESPONSE_FORMAT = {
    "type": "json_schema",
    "json_schema": {"name": "cues", "strict": True, "schema": reply_schema()},
}


class RefusedError(UnscoredError):
    """The server understood the request and will not answer it (400, 413, 422 and the like)."""


class PassingError(UnscoredError):
    """No answer this time; another try may bring one, ``after`` seconds at the earliest."""

    def __init__(self, reason: str, *, after: float = 0.0, nobody: bool = False) -> None:
        super().__init__(reason)
        self.after = after
        self.nobody = nobody
        """Whether nobody listens at the server's address."""


class QwenServer(QwenEvaluator):
    """Sends chats to ``BASE/chat/completions``."""

    def __init__(self, config: QwenConfig, *, seed: int, cache: Path | None) -> None:
        """Raises InputError when the address or the key of the environment cannot be used."""
        identity = json.dumps(["server", config.model, config.max_tokens, seed])
        super().__init__(config, model=config.model, identity=identity, cache=cache)
        self.workers = config.concurrency
        self._url = (config.base_url or os.environ.get(URL_VARIABLE, "").strip() or DEFAULT_URL).rstrip("/")
        try:
            check_base_url(self._url)
        except ValueError as error:
            raise InputError(str(error), hint=f"set rva.qwen.base_url or {URL_VARIABLE}") from None
        self._key = os.environ.get(KEY_VARIABLE, "").strip()
        if not (self._key.isascii() and self._key.isprintable()):
            raise InputError(
                f"{KEY_VARIABLE} holds characters that no key has", hint="set it to the key alone"
            )
        self._request = {
            "model": config.model,
            "temperature": 0,
            "seed": seed % 2**31,  # servers hold it in 32 bits
            "max_tokens": config.max_tokens,
        }
        self._takes_schema = True
        self._gone = ""
        """Why no frame is asked for any more."""
        self._stopped = Event()
        url = httpx2.URL(self._url)
        self._http = httpx2.Client(
            base_url=url,
            headers={"Authorization": f"Bearer {self._key}"} if self._key else None,
            trust_env=url.host not in ("localhost", "127.0.0.1", "::1"),
            limits=httpx2.Limits(max_connections=None),
        )

    def stop(self) -> None:
        """End pauses between tries, and start no further ones."""
        self._stopped.set()

    def check(self) -> None:
        """Raise InputError when nobody answers, the server refuses the key, or it lists its models and the
        one of the settings is not among them. A server that lists none passes.
        """
        model = self._config.model
        try:
            answer, raw = self._send("GET", "models", min(self._config.timeout_s, _MAX_CHECK_S))
        except PassingError:
            raise InputError(
                f"no server for {model} answers at {self._url}",
                hint=f"start one (vllm serve {model}), or set rva.qwen.base_url or {URL_VARIABLE}",
            ) from None
        if answer.status_code in (401, 403):
            raise InputError(f"the server at {self._url} refuses the key", hint=_KEY_HINT)
        try:
            served = [entry["id"] for entry in json.loads(raw)["data"]]
        except _NO_REPLY:
            return  # it answers; whether it has the model, the first frame will tell
        if served and model not in served:
            raise InputError(
                f"the server at {self._url} has no model {model}; "
                f"it has {', '.join(map(str, served))[:_SHOWN]}",
                hint="name one with --set rva.qwen.model=NAME, or serve the other",
            )

    def score(self, picture: EncodedImage) -> ArrayF64:
        """See `QwenEvaluator.score`. A reply outside the schema is answered with what is wrong with it."""
        if self._gone:
            raise UnscoredError(self._gone)  # this frame need not wait for the same end
        image = {"type": "image_url", "image_url": {"url": picture.data_url()}}
        text = {"type": "text", "text": prompt_text(masked=picture.masked)}
        question: dict[str, Any] = {"role": "user", "content": [image, text]}
        messages, fault = [question], ""
        for _ in range(self._config.asks):
            reply = self._reply(messages)
            try:
                return parse_reply(reply)
            except ReplyError as error:
                fault = str(error)
            complaint = f"This reply cannot be used: {fault}. Answer again with the JSON object alone."
            messages = [
                question,
                {"role": "assistant", "content": reply[:_REPEATED]},
                {"role": "user", "content": complaint},
            ]
        raise UnscoredError(f"the last of {self._config.asks} replies cannot be used: {fault}")

    def _reply(self, messages: list[dict[str, Any]]) -> str:
        """The model's text; by the schema where the server knows how to force it, else as it comes."""
        chat = {**self._request, "messages": messages}
        if self._takes_schema:
            with suppress(RefusedError):
                return self._complete({**chat, "response_format": _RESPONSE_FORMAT})
        reply = self._complete(chat)
        self._takes_schema = False  # the server takes the picture, but not the format
        return reply

    def _complete(self, body: Mapping[str, Any]) -> str:
        """The text of the reply to the chat ``body``.

        Raises UnscoredError where this chat gets none, StageError where none would: wrong key, model or
        address.
        """
        pause, tried = self._config.backoff_s, 0
        while True:
            try:
                return self._once(body)
            except PassingError as fault:
                tried += 1
                last = tried == self._config.attempts
                if last or self._stopped.wait(min(_MAX_PAUSE_S, max(pause, fault.after))):
                    reason = f"{fault} ({tried} tries)"
                    self._gone = reason if fault.nobody else self._gone
                    raise UnscoredError(reason) from None
                pause *= 2
            except StageError as fault:  # another thread may take the next frame before the stage ends
                self._gone = str(fault)
                raise

    def _once(self, body: Mapping[str, Any]) -> str:
        answer, raw = self._send("POST", "chat/completions", self._config.timeout_s, body)
        if not answer.is_success:
            raise self._refusal(answer, raw)
        try:
            text = json.loads(raw)["choices"][0]["message"]["content"]
        except _NO_REPLY:
            raise PassingError("the server's answer is no chat completion, or breaks off") from None
        return text if isinstance(text, str) else ""

    def _send(
        self, method: str, path: str, timeout: float, body: Mapping[str, Any] | None = None
    ) -> tuple[httpx2.Response, bytes]:
        """The answer and its content. Raises PassingError where none came whole within ``timeout`` s."""
        deadline, raw = time.monotonic() + timeout, b""
        try:
            with self._http.stream(method, path, json=body, timeout=timeout) as answer:
                for piece in answer.iter_bytes():
                    raw += piece
                    if time.monotonic() > deadline:  # it drips in
                        raise httpx2.ReadTimeout("late")
                    if len(raw) > _MAX_REPLY_BYTES:
                        raise PassingError("the server's answer is far too long")
        except httpx2.TimeoutException:
            raise PassingError(f"no answer within {timeout:g} s") from None
        except httpx2.ConnectError:
            raise PassingError(f"nobody answers at {self._url}", nobody=True) from None
        except httpx2.RequestError as error:
            raise PassingError(f"the connection broke off ({type(error).__name__})") from None
        return answer, raw

    def _refusal(self, answer: httpx2.Response, raw: bytes) -> Exception:
        """What an HTTP status other than 2xx means for us."""
        code = answer.status_code
        reason = f"the server answered {code}{self._message_of(raw)}"
        if code in _BUSY:
            return PassingError(reason, after=_retry_after(answer.headers.get("Retry-After", "")))
        where = f"{reason} at {self._url}"
        if code in (401, 403):
            return StageError(where, hint=_KEY_HINT)
        if code == 404:
            return StageError(where, hint="check rva.qwen.model and rva.qwen.base_url (it ends with /v1)")
        if code < 400:
            return StageError(f"{where}: it has moved", hint="set rva.qwen.base_url to its new address")
        return RefusedError(reason)

    def _message_of(self, raw: bytes) -> str:
        """The server's explanation in one short line, without the key."""
        text = raw.decode("utf-8", "replace")
        with suppress(ValueError, RecursionError):
            fault = json.loads(text)
            fault = fault.get("error", fault) if isinstance(fault, dict) else fault
            text = str(fault.get("message", fault) if isinstance(fault, dict) else fault)
        if self._key:
            text = text.replace(self._key, "***")
        text = " ".join(text.split())[:_SHOWN]
        return f": {text}" if text else ""


def _retry_after(value: str) -> float:
    """Seconds that a Retry-After header (a number, or a date) asks for."""
    try:
        seconds = float(value)
    except ValueError:
        try:
            seconds = (parsedate_to_datetime(value).astimezone(UTC) - datetime.now(UTC)).total_seconds()
        except ValueError:
            return 0.0
    return max(0.0, seconds)
