"""One request to an OpenAI-compatible server, tried again while the server is busy, fails or is silent.

Plain ``urllib``: no redirects are followed (they would carry the key to another host), no proxy stands before
a server on this machine, and no text of an error holds the key.
"""

from __future__ import annotations

import http.client
import json
import os
import socket
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from threading import Event
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.parse import urlsplit
from urllib.request import HTTPRedirectHandler, ProxyHandler, Request, build_opener

from cleargs.errors import InputError, StageError
from cleargs.rva.config import QwenConfig, check_base_url
from cleargs.rva.vlm.picture import UnscoredError

URL_VARIABLE = "CLEARGS_VLM_URL"
KEY_VARIABLE = "CLEARGS_VLM_API_KEY"
DEFAULT_URL = "http://127.0.0.1:8000/v1"

_BUSY = frozenset({408, 409, 425, 429, 500, 502, 503, 504, 529})
_MAX_PAUSE_S = 120.0  # s; also what a server may ask for with Retry-After
_MAX_REPLY_BYTES = 4 << 20  # bytes
_MAX_CHECK_S = 10.0  # s to wait for the list of models
_SHOWN = 200  # characters of a server's own words


class RefusedError(UnscoredError):
    """The server understood the request and will not answer it (400, 413, 422 and the like)."""


class UnreachableError(UnscoredError):
    """Nobody listens at the server's address."""


class _TransientError(Exception):
    """Worth another try, ``after`` seconds at the earliest where the server says so."""

    def __init__(self, reason: str, *, after: float | None = None, unreachable: bool = False) -> None:
        super().__init__(reason)
        self.after = after
        self.unreachable = unreachable


class _NoRedirect(HTTPRedirectHandler):
    def redirect_request(self, *_: object) -> None:
        return None


class ChatClient:
    """Sends chats to ``BASE/chat/completions``. Safe to use from several threads."""

    def __init__(self, config: QwenConfig) -> None:
        """Raises InputError when the address or the key of the environment cannot be used."""
        self.base_url = config.base_url or os.environ.get(URL_VARIABLE, "").strip() or DEFAULT_URL
        self.base_url = self.base_url.rstrip("/")
        try:
            check_base_url(self.base_url)
        except ValueError as error:
            raise InputError(str(error), hint=f"set rva.qwen.base_url or {URL_VARIABLE}") from None
        self._key = os.environ.get(KEY_VARIABLE, "").strip()
        if not (self._key.isascii() and self._key.isprintable()):
            # http.client would repeat the whole header in its complaint.
            raise InputError(
                f"{KEY_VARIABLE} holds characters that no key has", hint="set it to the key alone"
            )
        self._config = config
        self._stopped = Event()
        local = urlsplit(self.base_url).hostname in ("localhost", "127.0.0.1", "::1")
        self._opener = build_opener(_NoRedirect, *([ProxyHandler({})] if local else []))

    def stop(self) -> None:
        """End pauses between tries, and start no further ones."""
        self._stopped.set()

    def check_model(self) -> None:
        """Raise InputError when nobody answers, the server refuses the key, or it lists its models and the
        one of the settings is not among them. A server that lists none passes."""
        request = Request(f"{self.base_url}/models", headers=self._headers())
        serve = f"start one (vllm serve {self._config.model}), or set rva.qwen.base_url or {URL_VARIABLE}"
        try:
            with self._opener.open(request, timeout=min(self._config.timeout_s, _MAX_CHECK_S)) as response:
                served = [entry["id"] for entry in json.loads(response.read(_MAX_REPLY_BYTES))["data"]]
        except HTTPError as error:
            with error:
                if error.code in (401, 403):
                    raise InputError(
                        f"the server at {self.base_url} refuses the key",
                        hint=f"put the server's key into {KEY_VARIABLE} of the environment",
                    ) from None
            return  # it answers; whether it has the model, the first frame will tell
        except (OSError, http.client.HTTPException):
            raise InputError(
                f"no server for {self._config.model} answers at {self.base_url}", hint=serve
            ) from None
        except (ValueError, LookupError, TypeError, RecursionError):
            return
        if served and self._config.model not in served:
            raise InputError(
                f"the server at {self.base_url} has no model {self._config.model}; "
                f"it has {', '.join(map(str, served))[:_SHOWN]}",
                hint="name one with --set rva.qwen.model=NAME, or serve the other",
            )

    def complete(self, body: Mapping[str, Any]) -> str:
        """The text of the reply to the chat ``body``.

        Raises RefusedError or UnscoredError where this chat gets none, StageError where none would: wrong
        key, model or address.
        """
        data = json.dumps(body).encode()
        pause = self._config.backoff_s
        for left in reversed(range(self._config.attempts)):
            try:
                return self._once(data)
            except _TransientError as fault:
                if left and not self._stopped.wait(min(_MAX_PAUSE_S, max(pause, fault.after or 0.0))):
                    pause *= 2
                    continue
                kind = UnreachableError if fault.unreachable else UnscoredError
                raise kind(f"{fault} ({self._config.attempts - left} tries)") from None
        raise AssertionError("attempts is at least 1")

    def _once(self, data: bytes) -> str:
        headers = {"Content-Type": "application/json"} | self._headers()
        request = Request(f"{self.base_url}/chat/completions", data=data, headers=headers, method="POST")
        deadline = time.monotonic() + self._config.timeout_s
        try:
            with self._opener.open(request, timeout=self._config.timeout_s) as response:
                raw = _read(response, deadline)
        except HTTPError as error:
            with error:
                raise self._refusal(error) from None
        except (OSError, http.client.HTTPException) as error:
            raise self._broken(error) from None
        try:
            text = json.loads(raw)["choices"][0]["message"]["content"]
        except (ValueError, LookupError, TypeError, RecursionError):
            raise _TransientError("the server's answer is no chat completion, or breaks off") from None
        return text if isinstance(text, str) else ""

    def _headers(self) -> dict[str, str]:
        key = {"Authorization": f"Bearer {self._key}"} if self._key else {}
        return {"Accept": "application/json"} | key

    def _refusal(self, error: HTTPError) -> Exception:
        """What an HTTP status other than 2xx means for us."""
        try:
            words = self._words(error.read(_MAX_REPLY_BYTES))
        except (OSError, http.client.HTTPException):
            words = ""
        reason = f"the server answered {error.code}{words}"
        if error.code in _BUSY:
            return _TransientError(reason, after=_retry_after(error.headers.get("Retry-After")))
        where = f"{reason} at {self.base_url}"
        if error.code in (401, 403):
            return StageError(where, hint=f"put the server's key into {KEY_VARIABLE} of the environment")
        if error.code == 404:
            return StageError(where, hint="check rva.qwen.model and rva.qwen.base_url (it ends with /v1)")
        if error.code < 400:
            return StageError(f"{where}: it has moved", hint="set rva.qwen.base_url to its new address")
        return RefusedError(reason)

    def _broken(self, error: Exception) -> _TransientError:
        """What a connection that failed means for us."""
        cause = error.reason if isinstance(error, URLError) else error
        if isinstance(cause, TimeoutError):
            return _TransientError(f"no answer within {self._config.timeout_s:g} s")
        if isinstance(cause, ConnectionRefusedError | socket.gaierror):
            return _TransientError(f"nobody answers at {self.base_url}", unreachable=True)
        return _TransientError(f"the connection broke off ({type(cause).__name__})")

    def _words(self, raw: bytes) -> str:
        """The server's explanation in one short line, without the key."""
        text = raw.decode("utf-8", "replace")
        try:
            fault = json.loads(text)
            fault = fault.get("error", fault) if isinstance(fault, dict) else fault
            text = str(fault.get("message", fault) if isinstance(fault, dict) else fault)
        except (ValueError, RecursionError):
            pass
        if self._key:
            text = text.replace(self._key, "***")
        text = " ".join(text.split())[:_SHOWN]
        return f": {text}" if text else ""


def _read(response: http.client.HTTPResponse, deadline: float) -> bytes:
    """The whole body. Raises TimeoutError where it drips in until after the deadline, IncompleteRead where it
    is shorter than announced.
    """
    raw = b""
    while chunk := response.read1(1 << 16):
        raw += chunk
        if time.monotonic() > deadline:
            raise TimeoutError
        if len(raw) > _MAX_REPLY_BYTES:
            raise _TransientError("the server's answer is far too long")
    if response.length:
        raise http.client.IncompleteRead(raw, response.length)
    return raw


def _retry_after(value: str | None) -> float | None:
    """Seconds that a Retry-After header (a number, or a date) asks for."""
    try:
        return max(0.0, float(value or ""))
    except ValueError:
        pass
    try:
        date = parsedate_to_datetime(value or "")
    except ValueError:
        return None
    return max(0.0, (date.astimezone(UTC) - datetime.now(UTC)).total_seconds())
