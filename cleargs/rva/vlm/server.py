"""Qwen3-VL on an OpenAI-compatible server: one conversation per image.

A request is repeated if the server is busy, fails or does not answer. The API key is protected: redirects are
not followed (they would send the key to another host), a server on this machine is used without a proxy, and
error messages never contain the key.
"""

from __future__ import annotations

import base64
import json
import os
import time
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from threading import Event
from typing import Any

import cv2
import httpx2

from cleargs.errors import InputError, StageError
from cleargs.rva.config import QwenConfig, check_base_url
from cleargs.rva.vlm.prompt import ReplyError, parse_reply, prompt_text, reply_schema
from cleargs.types import ArrayF64, ImageU8

URL_VARIABLE = "CLEARGS_VLM_URL"
KEY_VARIABLE = "CLEARGS_VLM_API_KEY"
DEFAULT_URL = "http://127.0.0.1:8000/v1"

_RETRY_STATUSES = frozenset({408, 409, 425, 429, 500, 502, 503, 504, 529})
_MALFORMED = (ValueError, LookupError, TypeError, RecursionError)
_ATTEMPTS = 5  # tries of one request if the server is busy, fails or does not answer
_PAUSE_S = 1.0  # s before the second try; doubled before each further try
_MAX_PAUSE_S = 120.0  # s between tries; also limits Retry-After
_ASKS = 3  # questions per frame if the replies do not match the schema
_MAX_REPLY_BYTES = 4 << 20
_MAX_CHECK_S = 10.0  # s to wait for the list of models
_MAX_QUOTED = 200  # characters of the server's text in a message
_MAX_REPEATED = 2000  # characters of an invalid reply in the next question
_KEY_HINT = f"set the environment variable {KEY_VARIABLE} to the server's key"


_RESPONSE_FORMAT = {
    "type": "json_schema",
    "json_schema": {"name": "cues", "strict": True, "schema": reply_schema()},
}


class UnscoredError(Exception):
    """No valid scores for one frame, with the reason. Other frames may still be scored."""


class RefusedError(UnscoredError):
    """The server refuses the request (400, 413, 422 and similar)."""


class TransientError(UnscoredError):
    """No answer for now. A new try may succeed, after at least ``after`` seconds."""

    def __init__(self, reason: str, *, after: float = 0.0, unreachable: bool = False) -> None:
        super().__init__(reason)
        self.after = after
        self.unreachable = unreachable
        """True if no server listens at the address."""


class QwenServer:
    """Sends chats to ``BASE/chat/completions``."""

    def __init__(self, config: QwenConfig, *, seed: int) -> None:
        """Read the address and the key. Raise InputError if one of them is invalid."""
        self._config = config
        self._url = (config.base_url or os.environ.get(URL_VARIABLE, "").strip() or DEFAULT_URL).rstrip("/")
        try:
            check_base_url(self._url)
        except ValueError as error:
            raise InputError(str(error), hint=f"set rva.qwen.base_url or {URL_VARIABLE}") from None
        self._key = os.environ.get(KEY_VARIABLE, "").strip()
        if not (self._key.isascii() and self._key.isprintable()):
            raise InputError(
                f"{KEY_VARIABLE} contains characters that are invalid in a key", hint="set it to the key only"
            )
        self._request = {
            "model": config.model,
            "temperature": 0,
            "seed": seed % 2**31,  # servers store it in 32 bits
            "max_tokens": config.max_tokens,
        }
        self._takes_schema = True
        self._abandoned = ""
        """Reason to send no further requests; empty while there is none."""
        self._stopped = Event()
        url = httpx2.URL(self._url)
        self._http = httpx2.Client(
            base_url=url,
            headers={"Authorization": f"Bearer {self._key}"} if self._key else None,
            trust_env=url.host not in ("localhost", "127.0.0.1", "::1"),
            limits=httpx2.Limits(max_connections=None),
        )

    def stop(self) -> None:
        """End the pauses between tries, and try no request again."""
        self._stopped.set()

    def check(self) -> None:
        """Ask the server for its list of models; an unreadable or empty list is accepted.

        Raises InputError if the server does not answer, refuses the key, or lists models without that of the
        settings.
        """
        model = self._config.model
        try:
            answer, raw = self._send("GET", "models", min(self._config.timeout_s, _MAX_CHECK_S))
        except TransientError:
            raise InputError(
                f"no server for {model} answers at {self._url}",
                hint=f"start a server (vllm serve {model}), or set rva.qwen.base_url or {URL_VARIABLE}",
            ) from None
        if answer.status_code in (401, 403):
            raise InputError(f"the server at {self._url} refuses the key", hint=_KEY_HINT)
        try:
            served = [entry["id"] for entry in json.loads(raw)["data"]]
        except _MALFORMED:
            return  # the server answers; the first frame will show if it has the model
        if served and model not in served:
            raise InputError(
                f"the server at {self._url} has no model {model}; "
                f"it has {', '.join(map(str, served))[:_MAX_QUOTED]}",
                hint=f"choose one with --set rva.qwen.model=NAME, or serve {model}",
            )

    def score(self, rgb: ImageU8, *, masked: bool) -> ArrayF64:  # [h, w, 3] -> [11] in [0, 1]
        """Return the cues of one sRGB image, as `tables.CUE_COLUMNS`. If ``masked``, parts are painted grey.

        After an invalid reply the model gets the error and is asked again, up to `_ASKS` times in all.

        Raises UnscoredError if this image gets no scores, and StageError if no image would get scores.
        """
        if self._abandoned:
            raise UnscoredError(self._abandoned)  # do not wait for the same error again
        _, png = cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))  # lossless, to add no artifacts
        url = f"data:image/png;base64,{base64.b64encode(png.tobytes()).decode('ascii')}"
        content = [
            {"type": "image_url", "image_url": {"url": url}},
            {"type": "text", "text": prompt_text(masked=masked)},
        ]
        question: dict[str, Any] = {"role": "user", "content": content}
        messages, fault = [question], ""
        for _ in range(_ASKS):
            reply = self._reply(messages)
            try:
                return parse_reply(reply)
            except ReplyError as error:
                fault = str(error)
            complaint = f"This reply cannot be used: {fault}. Answer again with the JSON object alone."
            messages = [
                question,
                {"role": "assistant", "content": reply[:_MAX_REPEATED]},
                {"role": "user", "content": complaint},
            ]
        raise UnscoredError(f"the last of {_ASKS} replies is invalid: {fault}")

    def _reply(self, messages: list[dict[str, Any]]) -> str:
        """Return the model's text, constrained to the schema if the server supports that."""
        chat = {**self._request, "messages": messages}
        if self._takes_schema:
            with suppress(RefusedError):
                return self._complete({**chat, "response_format": _RESPONSE_FORMAT})
        reply = self._complete(chat)
        self._takes_schema = False  # the server accepts the image, but not the format
        return reply

    def _complete(self, body: Mapping[str, Any]) -> str:
        """Return the text of the reply to the chat ``body``.

        Raises UnscoredError if this chat gets no reply, and StageError if no chat would get one: wrong key,
        model or address.
        """
        pause, tried = _PAUSE_S, 0
        while True:
            try:
                return self._try_once(body)
            except TransientError as fault:
                tried += 1
                last = tried == _ATTEMPTS
                if last or self._stopped.wait(min(_MAX_PAUSE_S, max(pause, fault.after))):
                    reason = f"{fault} ({tried} tries)"
                    self._abandoned = reason if fault.unreachable else self._abandoned
                    raise UnscoredError(reason) from None
                pause *= 2
            except StageError as fault:  # other threads may start further frames before the stage ends
                self._abandoned = str(fault)
                raise

    def _try_once(self, body: Mapping[str, Any]) -> str:
        answer, raw = self._send("POST", "chat/completions", self._config.timeout_s, body)
        if not answer.is_success:
            raise self._refusal(answer, raw)
        try:
            text = json.loads(raw)["choices"][0]["message"]["content"]
        except _MALFORMED:
            raise TransientError("the server's answer is not a complete chat completion") from None
        return text if isinstance(text, str) else ""

    def _send(
        self, method: str, path: str, timeout: float, body: Mapping[str, Any] | None = None
    ) -> tuple[httpx2.Response, bytes]:
        """Return the answer and its content. Raise TransientError unless it is complete in ``timeout`` s."""
        deadline, raw = time.monotonic() + timeout, b""
        try:
            with self._http.stream(method, path, json=body, timeout=timeout) as answer:
                for piece in answer.iter_bytes():
                    raw += piece
                    if time.monotonic() > deadline:  # httpx2's timeout is per read
                        raise httpx2.ReadTimeout("late")
                    if len(raw) > _MAX_REPLY_BYTES:
                        raise TransientError("the server's answer is too long")
        except httpx2.TimeoutException:
            raise TransientError(f"no answer within {timeout:g} s") from None
        except httpx2.ConnectError:
            raise TransientError(f"no server answers at {self._url}", unreachable=True) from None
        except httpx2.RequestError as error:
            raise TransientError(f"the connection failed ({type(error).__name__})") from None
        return answer, raw

    def _refusal(self, answer: httpx2.Response, raw: bytes) -> Exception:
        """Return the exception for an HTTP status other than 2xx."""
        code = answer.status_code
        reason = f"the server answered {code}{self._message_of(raw)}"
        if code in _RETRY_STATUSES:
            return TransientError(reason, after=_retry_after(answer.headers.get("Retry-After", "")))
        where = f"{reason} at {self._url}"
        if code in (401, 403):
            return StageError(where, hint=_KEY_HINT)
        if code == 404:
            return StageError(where, hint="check rva.qwen.model and rva.qwen.base_url (it ends with /v1)")
        if code < 400:
            return StageError(f"{where}: it has moved", hint="set rva.qwen.base_url to the new address")
        return RefusedError(reason)

    def _message_of(self, raw: bytes) -> str:
        """Return the server's explanation as one short line, without the key."""
        text = raw.decode("utf-8", "replace")
        with suppress(ValueError, RecursionError):
            fault = json.loads(text)
            fault = fault.get("error", fault) if isinstance(fault, dict) else fault
            text = str(fault.get("message", fault) if isinstance(fault, dict) else fault)
        if self._key:
            text = text.replace(self._key, "***")
        text = " ".join(text.split())[:_MAX_QUOTED]
        return f": {text}" if text else ""


def _retry_after(value: str) -> float:
    """Return the seconds of a Retry-After header (a number or a date); 0 if it is invalid."""
    try:
        seconds = float(value)
    except ValueError:
        try:
            seconds = (parsedate_to_datetime(value).astimezone(UTC) - datetime.now(UTC)).total_seconds()
        except ValueError:
            return 0.0
    return max(0.0, seconds)
