"""``cleargs watch`` over real sockets: the responses that it sends, and the requests that it refuses."""

from __future__ import annotations

import http.client
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import click
import pytest
from report_run import FinishedRun, camera, wall
from watched import reported, serving, working

from cleargs.cli.main import invoke
from cleargs.errors import InputError
from cleargs.media.image import write_rgb
from cleargs.progress import PREVIEW
from cleargs.report.serve import Server
from cleargs.splat.render import Viewer


@dataclass
class Answer:
    status: int
    headers: dict[str, str]
    body: bytes


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    return reported(tmp_path_factory.mktemp("watch"))


@pytest.fixture(scope="module")
def port(finished: FinishedRun) -> Iterator[int]:
    with serving(finished) as number:
        yield number


def ask(port: int, path: str, method: str = "GET", headers: dict[str, str] | None = None) -> Answer:
    """The server's response to a request, with ``path`` sent unchanged."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.putrequest(method, path, skip_host=True)
    for name, value in ({"Host": f"127.0.0.1:{port}"} if headers is None else headers).items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    found = Answer(answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read())
    connection.close()
    return found


# -- responses ---------------------------------------------------------------------------------------------


def test_a_finished_run_is_its_report(finished: FinishedRun, port: int) -> None:
    assert ask(port, "/").headers["location"] == "/report/"
    page = ask(port, "/report/")
    assert page.status == 200 and page.headers["content-type"] == "text/html"
    assert page.body == (finished.folder / "report/index.html").read_bytes()
    for name in ("viewer.js", "report.json", "scene.jpg"):
        found = ask(port, f"/report/{name}")
        assert found.status == 200 and found.body == (finished.folder / "report" / name).read_bytes()
    assert ask(port, "/report/scene.jpg").headers["content-type"] == "image/jpeg"
    assert ask(port, "/report/none.jpg").status == ask(port, "/report/frames").status == 404
    assert json.loads(ask(port, "/state.json").body)["done"] is True


def test_a_browser_that_asks_for_an_icon_gets_no_error(port: int) -> None:
    answer = ask(port, "/favicon.ico")
    assert answer.status == 204 and answer.body == b""


def test_a_running_stage_shows_progress_and_preview(finished: FinishedRun, port: int) -> None:
    assert ask(port, "/preview.png").status == 404
    with working(finished, "rivr") as (_, checkpoints):
        page = ask(port, "/")
        assert page.status == 200 and b"/live.js" in page.body
        state = json.loads(ask(port, "/state.json").body)
        assert state["now"]["stage"] == "rivr" and state["preview"] is None and state["report"] is True
        assert {entry["name"]: entry["state"] for entry in state["stages"]} == {
            "ingest": "done",
            "rva": "done",
            "g0": "done",
            "rivr": "running",
            "consolidate": "done",
        }
        versions = []
        for seed in (1, 2):
            write_rgb(checkpoints / "round_01" / PREVIEW, Viewer(wall(seed)).view(camera(1)))
            versions.append(json.loads(ask(port, "/state.json").body)["preview"])
            shown = ask(port, "/preview.png?1")
            assert shown.headers["content-type"] == "image/png"
            assert shown.body == (checkpoints / "round_01" / PREVIEW).read_bytes()
        assert versions[0] != versions[1]
    assert json.loads(ask(port, "/state.json").body)["now"] is None
    assert ask(port, "/preview.png").status == 404 and ask(port, "/").status == 302


def test_results_without_their_report(finished: FinishedRun, tmp_path: Path) -> None:
    """The page waits. It links to an older report, but does not treat it as the present one."""
    made = FinishedRun(tmp_path)
    with serving(made) as port:
        assert ask(port, "/").status == 200 and ask(port, "/report/").status == 404
        state = json.loads(ask(port, "/state.json").body)
        assert (state["done"], state["report"], state["now"]) == (False, False, None)
        shutil.copytree(finished.folder / "report", made.folder / "report")
        record = made.folder / "report/report.json"
        record.write_text(record.read_text().replace('"made_from"', '"before"'))
        state = json.loads(ask(port, "/state.json").body)
        assert (state["done"], state["report"]) == (False, True)


def test_names_of_runs_and_labels_stay_text(finished: FinishedRun, port: int) -> None:
    """The script never inserts the state as HTML."""
    script = ask(port, "/live.js").body.decode()
    assert "innerHTML" not in script and "insertAdjacentHTML" not in script
    assert ask(port, "/live.css").headers["content-type"].startswith("text/css")


# -- refused requests --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "path",
    [
        "/report/../run.toml",
        "/report/%2e%2e/run.toml",
        "/report/..%2frun.toml",
        "/report/frames/../../run.toml",
        "/report//etc/passwd",
        "/report/%2fetc%2fpasswd",
        "/report/index.html%00.txt",
        "/report/link.toml",
        "/report/folder/run.toml",
        "/report/loop",
        "/report/pipe",
        "/run.toml",
        "/../run.toml",
        "/live.html",
        "//run.toml",
        "/report/" + "x" * 5000,
    ],
)
def test_nothing_outside_the_report_is_handed_out(finished: FinishedRun, port: int, path: str) -> None:
    report = finished.folder / "report"
    for name, target in (("link.toml", "../run.toml"), ("folder", ".."), ("loop", "loop")):
        if not (report / name).is_symlink():
            (report / name).symlink_to(target)
    if not (report / "pipe").exists():
        os.mkfifo(report / "pipe")
    answer = ask(port, path)
    assert answer.status == 404 and b"rva" not in answer.body and b"root:" not in answer.body


def test_a_report_folder_that_is_a_link_elsewhere(tmp_path: Path) -> None:
    made = FinishedRun(tmp_path)
    (made.folder / "report").symlink_to(made.folder / "ingest")
    with serving(made) as port:
        assert ask(port, "/report/manifest.json").status == 404
        (made.folder / "report").unlink()
        (made.folder / "report").symlink_to(made.folder / "run.toml")
        assert ask(port, "/report").status == 404


@pytest.mark.parametrize(
    "name", ["evil.example", "evil.example:{port}", "127.0.0.1.evil.example", "", "a b", "[::1"]
)
def test_another_name_gets_nothing(port: int, name: str) -> None:
    """Such requests come from a browser for which a foreign name resolves to this machine."""
    for path in ("/", "/report/", "/state.json", "/preview.png"):
        answer = ask(port, path, headers={"Host": name.format(port=port)})
        assert answer.status == 403 and b"Gaussians" not in answer.body


def test_a_request_must_name_its_host(port: int) -> None:
    assert ask(port, "/state.json", headers={}).status == 403


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost", "LOCALHOST:80", "[::1]:{port}"])
def test_our_own_names_are_answered(port: int, name: str) -> None:
    assert ask(port, "/state.json", headers={"Host": name.format(port=port)}).status == 200


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "CONNECT", "BREW"])
def test_nothing_can_be_sent(port: int, method: str) -> None:
    assert ask(port, "/state.json", method).status in (405, 501)


def test_head_has_the_headers_alone(port: int) -> None:
    whole, head = ask(port, "/report/"), ask(port, "/report/", "HEAD")
    assert head.body == b"" and head.headers["content-length"] == whole.headers["content-length"]


@pytest.mark.parametrize("path", ["/report/", "/state.json", "/none", "/", "/live.js"])
def test_security_headers(port: int, path: str) -> None:
    headers = ask(port, path).headers
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["cross-origin-resource-policy"] == "same-origin"
    assert "access-control-allow-origin" not in headers and "python" not in headers["server"].lower()
    assert ("content-security-policy" in headers) == (path in ("/", "/live.js"))


def test_the_address_is_local_and_errors_are_reported(finished: FinishedRun) -> None:
    with Server(finished.dag, finished.run, "127.0.0.1", 0) as server:
        assert server.address == f"http://127.0.0.1:{server.server_address[1]}/"
        with pytest.raises(InputError, match="cannot serve at"):
            Server(finished.dag, finished.run, "127.0.0.1", int(server.server_address[1]))
    with pytest.raises(InputError, match="cannot serve at"):
        Server(finished.dag, finished.run, "no such host", 0)
    with pytest.raises(InputError, match="the host has no name"):
        Server(finished.dag, finished.run, "", 0)  # an unset variable: all addresses of the machine


def test_open_shows_the_page_in_the_browser(finished: FinishedRun, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr(click, "launch", opened.append)
    monkeypatch.setattr(Server, "serve_forever", lambda server: None)
    assert invoke(["watch", str(finished.folder), "--open"]) == 0
    assert invoke(["report", str(finished.folder), "--open", "-q"]) == 0
    served, written = opened
    assert served.startswith("http://127.0.0.1:") and written == (finished.folder / "report.html").as_uri()


def test_ctrl_c_ends_it_without_a_word(finished: FinishedRun) -> None:
    program = "from cleargs.cli.entry import main; main()"
    command = [sys.executable, "-c", program, "watch", str(finished.folder)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    address = process.stdout.readline().split()[0]
    assert address.startswith("http://127.0.0.1:")
    assert ask(int(address.rstrip("/").rpartition(":")[2]), "/report/").status == 200
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 0 and errors == ""
