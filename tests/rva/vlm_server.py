"""A server with an OpenAI-compatible chat endpoint on loopback, and a small capture to score."""

from __future__ import annotations

import base64
import json
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pyarrow as pa
from pydantic import BaseModel, ConfigDict

from cleargs.capture import tables as ingest
from cleargs.parquet import write_table
from cleargs.pipeline.stage import Estimate, StageContext, StageResult
from cleargs.pipeline.stages import Stages
from cleargs.rva.tables import B_CUES, CUE_COLUMNS, R_CUES

KEY = "sk-Loopback+Secret/7491"
FRAMES = 6


@dataclass
class Answer:
    """Answer of the server."""

    content: str = ""
    """The model's text, sent in a chat completion."""
    status: int = 200
    headers: Mapping[str, str] = field(default_factory=dict)
    body: bytes | None = None
    """Sent instead of a chat completion."""
    announced: int | None = None
    """Content-Length, if it should be wrong."""
    delay: float = 0.0
    """Seconds before the first byte."""
    drip: float = 0.0
    """Seconds before each further byte."""


@dataclass
class Request:
    """One request as the server received it."""

    headers: Mapping[str, str]
    chat: dict[str, Any]

    @property
    def image(self) -> npt.NDArray[np.uint8]:  # [H, W, 3] BGR
        url = self.chat["messages"][0]["content"][0]["image_url"]["url"]
        assert url.startswith("data:image/png;base64,")
        data = np.frombuffer(base64.b64decode(url.partition(",")[2]), np.uint8)
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)

    @property
    def frame(self) -> int:
        """Number of the frame of `make_ingest` that it shows."""
        return round(float(self.image[0, 0, 0]) / 20) - 1


Script = Callable[[Request, int], Answer]
"""Request, number of earlier requests for the same frame -> answer."""


def truth(frame: int) -> dict[str, float]:
    """Scores of a frame by the names of the prompt. Each frame is worse than the one before."""
    good = round(0.95 - 0.15 * frame, 2)
    return {**dict.fromkeys(R_CUES, good), **dict.fromkeys(B_CUES, round(1.0 - good, 2))}


def true_cues(frame: int) -> dict[str, float]:
    """`truth` by the columns of the table."""
    return dict(zip(CUE_COLUMNS, truth(frame).values(), strict=True))


def answer_truth(request: Request, before: int) -> Answer:
    """The script of a server without faults."""
    return Answer(json.dumps(truth(request.frame)))


@dataclass
class Log:
    """Requests that a server received."""

    url: str
    requests: list[Request] = field(default_factory=list)
    most_at_once: int = 0

    def frames(self) -> list[int]:
        return sorted(request.frame for request in self.requests)


@contextmanager
def vlm_server(script: Script = answer_truth, port: int = 0, dies_with: int | None = None) -> Iterator[Log]:
    """Run a server that answers by ``script`` until the block ends, or until request number ``dies_with``."""
    lock = threading.Lock()
    busy = [0]

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            with lock:
                busy[0] += 1
                log.most_at_once = max(log.most_at_once, busy[0])
                request = Request(dict(self.headers), json.loads(body))
                before = log.frames().count(request.frame)
                log.requests.append(request)
            if len(log.requests) == dies_with:
                server.shutdown()
                server.server_close()
            try:
                assert self.path == "/v1/chat/completions"
                self._send(script(request, before))
            except (BrokenPipeError, ConnectionResetError):
                pass  # the client gave up
            finally:
                with lock:
                    busy[0] -= 1

        def _send(self, answer: Answer) -> None:
            time.sleep(answer.delay)
            whole = {"choices": [{"message": {"role": "assistant", "content": answer.content}}]}
            body = json.dumps(whole).encode() if answer.body is None else answer.body
            self.send_response(answer.status)
            for name, value in answer.headers.items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(answer.announced or len(body)))
            self.end_headers()
            if not answer.drip:
                self.wfile.write(body)
                return
            for byte in body:
                self.wfile.write(bytes([byte]))
                time.sleep(answer.drip)

        def log_message(self, *_: object) -> None: ...

    server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
    server.daemon_threads = True
    log = Log(f"http://127.0.0.1:{server.server_address[1]}/v1")
    thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
    thread.start()
    try:
        yield log
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def make_ingest(folder: Path) -> None:
    """Write the outputs of ingest for `FRAMES` frames. The level of the pixels encodes the frame number."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    rows = []
    for k in range(FRAMES):
        cv2.imwrite(str(folder / "images" / f"{k:06d}.png"), np.full((60, 80, 3), 20 * (k + 1), np.uint8))
        rows.append(
            {
                "frame_id": k,
                "name": f"{k}.jpg",
                "image": f"images/{k:06d}.png",
                **{"width": 80, "height": 60, "fx": 70.0, "fy": 70.0, "cx": 40.0, "cy": 30.0},
                **{"qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0, "tx": -0.1 * k, "ty": 0.0, "tz": 0.0},
                "registered": True,
                "n_points": 2,
                "split": "train",
            }
        )
    write_table(folder / "frames.parquet", pa.Table.from_pylist(rows, schema=ingest.FRAMES), ingest.FRAMES)
    frames = np.repeat(np.arange(FRAMES, dtype=np.int32), 2)
    seen = pa.table(
        {"frame_id": frames, "point_id": frames.astype(np.int64) + np.tile([0, 1], FRAMES)},
        schema=ingest.OBSERVATIONS,
    )
    write_table(folder / "observations.parquet", seen, ingest.OBSERVATIONS)
    write_table(folder / "points.parquet", ingest.POINTS.empty_table(), ingest.POINTS)


class PreparedConfig(BaseModel):
    """The settings of ingest that the report's outcome reads."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    fps: float | None = None
    max_frames: int = FRAMES


@dataclass
class PreparedIngest:
    """A stage with the outputs of `make_ingest`."""

    VERSION: int = 1
    CONFIG: type[BaseModel] = PreparedConfig
    INPUTS: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    OUTPUTS: tuple[str, ...] = ("frames.parquet", "points.parquet", "observations.parquet", "images")
    LEFTOVERS: tuple[str, ...] = ()
    SETTINGS: tuple[str, ...] = ()
    LIBRARIES: tuple[str, ...] = ()

    def externals(self, config: Any, source: Path) -> Mapping[str, Path]:
        return {}

    def preflight(self, config: Any) -> None: ...

    def estimate(self, context: StageContext[Any]) -> Estimate:
        return Estimate(minutes=0.1, memory_gb=0.1, disk_gb=0.001)

    def run(self, context: StageContext[Any]) -> StageResult:
        make_ingest(context.out)
        return StageResult()


def two_stages() -> Stages:
    """The real RVA stage after `PreparedIngest`."""
    stages: dict[str, Any] = {"ingest": PreparedIngest(), "rva": import_module("cleargs.stages.rva")}
    return Stages(tuple(stages), stages.__getitem__)
