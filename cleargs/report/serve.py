"""The server of `cleargs watch`: one run's report and its present state, for readers on this machine.

It answers GET and HEAD alone, changes nothing, and hands out no file but those of the report and the youngest
preview. A page of another site may make a browser ask a server on this machine, under a name that it had
resolve here (DNS rebinding): whoever asks under such a name gets nothing.
"""

from __future__ import annotations

import json
import shutil
import socket
import sys
from collections.abc import Mapping
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from io import BytesIO
from ipaddress import ip_address
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import unquote, urlsplit

from cleargs.errors import InputError
from cleargs.manifest import plain_json
from cleargs.report.report_json import FOLDER, PAGE
from cleargs.report.watched_run import Watched
from cleargs.untrusted import open_regular

_TYPES: Mapping[str, str] = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".json": "application/json",
    ".txt": "text/plain; charset=utf-8",
    ".jpg": "image/jpeg",
    ".png": "image/png",
    ".svg": "image/svg+xml",
}
_FOREIGN = "; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
_LIVE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'" + _FOREIGN
)
_REPORT_POLICY = (  # as in the report itself, whose script and viewer it needs
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' 'self' blob:; worker-src blob:; "
    "connect-src blob: data:; img-src 'self' blob: data:; style-src 'unsafe-inline'" + _FOREIGN
)
_OURS = {f"/{name}": name for name in ("live.css", "live.js")}


class Server(ThreadingHTTPServer):
    """Serves ``watched`` at ``host`` (a name or an address) and ``port`` (0: one that is free).

    Raises InputError when that cannot be had.
    """

    daemon_threads = True

    def __init__(self, watched: Watched, host: str, port: int) -> None:
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            super().__init__((host, port), partial(_Handler, watched, host))
        except OSError as error:
            raise InputError(
                f"cannot serve at {host}:{port}: {error.strerror or error}",
                hint="choose another --port (0: one that is free), and a --host of this machine",
            ) from error

    @property
    def address(self) -> str:
        """Where a browser on this machine finds it."""
        host, port = self.server_address[:2]
        name = f"[{host!s}]" if ":" in str(host) else str(host)
        return f"http://{name}:{port}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """One line for what went wrong; a reader that went away is no error."""
        error = sys.exception()
        if not isinstance(error, ConnectionError | TimeoutError):
            print(f"warning: a request failed: {error!r}", file=sys.stderr)


class _Handler(BaseHTTPRequestHandler):
    """One request."""

    server_version, sys_version = "cleargs", ""
    timeout = 30

    def __init__(self, watched: Watched, host: str, *arguments: Any) -> None:
        self._watched, self._host = watched, host
        self._policy = _LIVE_POLICY
        super().__init__(*arguments)

    def do_GET(self) -> None:
        if not self._asked_by_name():
            self.send_error(HTTPStatus.FORBIDDEN, explain="This server answers to its own address only.")
            return
        path = unquote(urlsplit(self.path).path)
        if path == "/":
            if self._watched.is_done():
                self._redirect(f"/{FOLDER}/")
            else:
                self._send(_static("live.html"), ".html")
        elif path in _OURS:
            self._send(_static(_OURS[path]), Path(path).suffix)
        elif path == "/state.json":
            self._send(json.dumps(plain_json(self._watched.state())).encode(), ".json")
        elif path == "/favicon.ico":  # asked for by every browser; we have none
            self.send_response(HTTPStatus.NO_CONTENT)
            self.end_headers()
        elif path == "/preview.png":
            self._send_file(self._watched.preview())
        elif path == f"/{FOLDER}":
            self._redirect(f"/{FOLDER}/")
        elif path.startswith(f"/{FOLDER}/"):
            self._policy = _REPORT_POLICY
            self._send_file(self._in_report(path.removeprefix(f"/{FOLDER}/") or PAGE))
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    do_HEAD = do_GET  # the body is left out by `_send_stream`

    def _refuse(self) -> None:
        self.send_error(HTTPStatus.METHOD_NOT_ALLOWED)

    do_POST = do_PUT = do_DELETE = do_PATCH = do_OPTIONS = do_TRACE = do_CONNECT = _refuse

    def end_headers(self) -> None:
        self.send_header("Content-Security-Policy", self._policy)
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("Cache-Control", "no-store")
        super().end_headers()

    def log_message(self, format: str, *arguments: Any) -> None:
        """Requests are of no interest."""

    def _asked_by_name(self) -> bool:
        """Whether the address that the reader asked is one of ours: an IP address, which no other site can
        have for its name, or the name that the server was given."""
        named = self.headers.get_all("Host", [])
        if len(named) != 1:
            return False
        try:
            host = urlsplit(f"//{named[0]}").hostname or ""
            if host in ("localhost", self._host.lower()):
                return True
            ip_address(host)
        except ValueError:
            return False
        return True

    def _in_report(self, name: str) -> Path | None:
        """The file ``name`` of the report; None where there is none, or where it lies elsewhere."""
        root = self._watched.folder.resolve() / FOLDER
        try:
            file = (root / name).resolve()
        except (OSError, ValueError, RuntimeError):  # a zero byte, a name too long, a loop of links
            return None
        return file if file.is_relative_to(root) else None

    def _redirect(self, place: str) -> None:
        self.send_response(HTTPStatus.FOUND)
        self.send_header("Location", place)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def _send_file(self, path: Path | None) -> None:
        try:
            if path is None:
                raise FileNotFoundError
            file = open_regular(path)
        except OSError:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        with file:
            size = file.seek(0, 2)
            file.seek(0)
            self._send_stream(file, size, path.suffix)

    def _send(self, body: bytes, suffix: str) -> None:
        self._send_stream(BytesIO(body), len(body), suffix)

    def _send_stream(self, body: BinaryIO, size: int, suffix: str) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", _TYPES.get(suffix, "application/octet-stream"))
        self.send_header("Content-Length", str(size))
        self.end_headers()
        if self.command != "HEAD":
            shutil.copyfileobj(body, self.wfile)


def _static(name: str) -> bytes:
    return files("cleargs.report").joinpath("static", name).read_bytes()
