"""The server of ``cleargs watch``, which shows the report of one run and its progress.

It is read-only, and serves only the files of the report and the latest preview. A page of another site may
make a browser request this server under a foreign name (DNS rebinding), so the server refuses other names.
"""

from __future__ import annotations

import json
import os
import socket
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from http import HTTPStatus
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from ipaddress import ip_address
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import urlsplit

from cleargs.errors import InputError
from cleargs.manifest import plain_json
from cleargs.pipeline.live import preview_of, running_stage, stage_at_work
from cleargs.pipeline.run_file import RunSpec
from cleargs.pipeline.stages import Stages
from cleargs.report.report_json import FOLDER, PAGE, is_current, linked_manifests, page_of
from cleargs.safe_io import faults_as, open_own

_PAGES: Mapping[str, str] = {"/": "live.html", "/live.css": "live.css", "/live.js": "live.js"}
_POLICY = "default-src 'self'; base-uri 'none'; form-action 'none'"


class Server(ThreadingHTTPServer):
    """The HTTP server of a run, at a host name or IP address and a port (0: any free port).

    Raises InputError if the address is not available.
    """

    daemon_threads = True

    def __init__(self, dag: Stages, run: RunSpec, host: str, port: int) -> None:
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        hint = "choose another --port (0: any free port), or a --host of this machine"
        with faults_as(InputError, f"cannot serve at {host}:{port}", hint=hint, faults=(OSError,)):
            if not host:  # it would be every address of this machine
                raise OSError("the host has no name")
            super().__init__((host, port), partial(_Handler, dag, run, host))

    @property
    def address(self) -> str:
        """URL for a browser on this machine."""
        host, port = self.server_address[:2]
        name = f"[{host!s}]" if ":" in str(host) else str(host)
        return f"http://{name}:{port}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print one line for a failure. A closed connection does not count as one."""
        error = sys.exception()
        if not isinstance(error, ConnectionError | TimeoutError):
            print(f"warning: a request failed: {error!r}", file=sys.stderr)


class _Handler(SimpleHTTPRequestHandler):
    """Handler of one request: the live page and its data, the preview, or a file of the report."""

    server_version, sys_version = "cleargs", ""
    timeout = 30

    def __init__(self, dag: Stages, run: RunSpec, host: str, *arguments: Any) -> None:
        self._dag, self._run, self._host, self.path = dag, run, host, ""
        super().__init__(*arguments, directory=str(run.folder))

    def send_head(self) -> BytesIO | BinaryIO | None:
        """Send the headers, and return the body."""
        path = urlsplit(self.path).path
        if not self._has_own_name():
            self.send_error(HTTPStatus.FORBIDDEN, explain="This server answers only to its own address.")
        elif path == "/favicon.ico":  # every browser requests it
            self.send_response(HTTPStatus.NO_CONTENT)
            self.end_headers()
        elif path == "/" and self._state()["done"]:
            self.send_response(HTTPStatus.FOUND)
            self.send_header("Location", f"/{FOLDER}/")
            self.send_header("Content-Length", "0")
            self.end_headers()
        elif path == "/state.json":
            body = json.dumps(plain_json(self._state())).encode()
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            return BytesIO(body)
        else:
            return super().send_head()
        return None

    def translate_path(self, path: str) -> str:
        """Return the file for a URL; "" if it is not served."""
        url_path = urlsplit(path).path
        if url_path in _PAGES:
            return str(Path(__file__).parent / "static" / _PAGES[url_path])
        if url_path == "/preview.png":
            work = running_stage(self._run.folder, self._run.store)
            preview = None if work is None else preview_of(work, self._run.store)
            return "" if preview is None else str(preview.path)
        report = self._run.folder / FOLDER
        file = Path(super().translate_path(path)) / (PAGE if url_path == f"/{FOLDER}/" else "")
        with suppress(OSError, ValueError):  # a link, a zero byte, a long name, a file outside the report
            if file.relative_to(report).parts:
                os.close(open_own(file, self._run.folder))
                return str(file)
            if report.is_dir() and not report.is_symlink():  # it is redirected to its page
                return str(file)
        return ""

    def list_directory(self, path: Any) -> None:
        """Send an error instead of a listing, for a report without its page."""
        self.send_error(HTTPStatus.NOT_FOUND)

    def end_headers(self) -> None:
        if urlsplit(self.path).path in _PAGES:  # the page of the report contains its policy
            self.send_header("Content-Security-Policy", _POLICY)
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("Cache-Control", "no-store")
        super().end_headers()

    def log_message(self, format: str, *arguments: Any) -> None:
        """Log nothing."""

    def _has_own_name(self) -> bool:
        """Return True for a request to our name, or to an IP address, which no other site has as its name."""
        try:
            name = urlsplit(f"//{self.headers['Host']}").hostname or ""
            return name in ("localhost", self._host.lower()) or ip_address(name) is not None
        except ValueError:
            return False

    def _state(self) -> dict[str, Any]:
        """Return the data of the live page as JSON values."""
        run = self._run
        work = running_stage(run.folder, run.store)
        manifests = linked_manifests(run.folder, self._dag.names)
        preview = None if work is None else preview_of(work, run.store)
        stages = []
        stopped = stage_at_work(run.folder, run.store)
        for name in run.stages(self._dag):
            running = work is not None and work.stage == name
            state = "running" if running else "done" if name in manifests else "to do"
            seconds = manifests[name].seconds if state == "done" else None
            stages.append({"name": name, "state": state, "seconds": seconds})
        return {
            "name": run.folder.name,
            "now": None if work is None else work.model_dump() | {"seconds": time.time() - work.begun},
            "stopped": None if work or stopped is None else ": ".join(stopped),
            "stages": stages,
            "preview": None if preview is None else str(preview.version),
            "report": page_of(run.folder).is_file(),
            "done": work is None and is_current(run.folder, manifests),
        }
