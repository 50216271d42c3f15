"""Qwen3-VL with a real HTTP server on loopback that answers correctly, badly, late, or not at all."""

from __future__ import annotations

import json
import socket
import sys
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from vlm_server import (
    FRAMES,
    KEY,
    Answer,
    Request,
    answer_truth,
    make_ingest,
    true_cues,
    truth,
    two_stages,
    vlm_server,
)

from cleargs.cli.main import invoke
from cleargs.errors import ConfigError, InputError, StageError
from cleargs.parquet import read_table
from cleargs.pipeline.config import check_document
from cleargs.pipeline.stage import StageContext, StageResult
from cleargs.progress import SilentReporter
from cleargs.rivr.targets import load_supervision
from cleargs.rva import tables
from cleargs.rva.vlm import server
from cleargs.stages.rva import RvaConfig

MODEL = "Qwen/Qwen3-VL-8B-Instruct"


class Remarks(SilentReporter):
    def __init__(self) -> None:
        self.warnings: list[str] = []

    def warn(self, text: str) -> None:
        self.warnings.append(text)


Rows = dict[int, dict[str, Any]]


class Bench:
    """The RVA stage on a capture of six frames. A second call resumes from the cache of the first."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.remarks = Remarks()
        make_ingest(root / "ingest")
        for name in ("out", "checkpoints"):
            (root / name).mkdir()

    def run(self, url: str, **settings: Any) -> tuple[StageResult, Rows]:
        """Run with these settings of qwen3-vl. Names in capitals are constants of its modules."""
        with pytest.MonkeyPatch.context() as constants:
            for name in [name for name in settings if name.isupper()]:
                module = "evaluator" if name == "LONG_SIDE" else "server"
                constants.setattr(f"cleargs.rva.vlm.{module}._{name}", settings.pop(name))
            return self._run({"model": MODEL, "base_url": url, "timeout_s": 10, **settings})

    def _run(self, qwen: dict[str, Any]) -> tuple[StageResult, Rows]:
        context = StageContext(
            config=RvaConfig.model_validate({"evaluator": "qwen3-vl", "qwen": qwen}),
            source=self.root,
            inputs={"ingest": self.root / "ingest"},
            externals={},
            out=self.root / "out",
            checkpoints=self.root / "checkpoints",
            cache=self.root / "kept",
            seed=7,
            device="cpu",
            threads=1,
            reporter=self.remarks,
        )
        result = import_module("cleargs.stages.rva").run(context)
        table = read_table(self.root / "out" / "frames.parquet", tables.FRAMES).to_pylist()
        return result, {row["frame_id"]: row for row in table}

    def bytes(self) -> dict[str, bytes]:
        return {file.name: file.read_bytes() for file in (self.root / "out").iterdir()}


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    for name in ("CLEARGS_VLM_URL", "CLEARGS_VLM_MODEL", "http_proxy", "HTTP_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("CLEARGS_VLM_API_KEY", KEY)
    monkeypatch.setattr(server, "_PAUSE_S", 0.0)
    return Bench(tmp_path)


def cues_of(row: dict[str, Any]) -> dict[str, float]:
    return {column: row[column] for column in tables.CUE_COLUMNS}


def assert_complete(result: StageResult, rows: Rows) -> None:
    assert result.missing == ()
    assert {k: cues_of(row) for k, row in rows.items()} == {k: true_cues(k) for k in range(FRAMES)}


def first(answer: Answer) -> Callable[[Request, int], Answer]:
    """A script that gives ``answer`` to the first request of every frame, then correct answers."""
    return lambda request, before: answer if before == 0 else answer_truth(request, before)


def test_a_server_that_answers_well(bench: Bench) -> None:
    with vlm_server() as log:
        result, rows = bench.run(log.url, LONG_SIDE=64)
    assert_complete(result, rows)
    assert {row["evaluator"] for row in rows.values()} == {f"qwen3-vl:{MODEL}:prompt-1"}
    assert rows[0]["role"] == "strong" and rows[5]["R"] == pytest.approx(0.2)
    assert log.frames() == list(range(FRAMES))
    for request in log.requests:
        assert request.headers["Authorization"] == f"Bearer {KEY}"
        assert request.chat["model"] == MODEL
        assert request.chat["temperature"] == 0 and request.chat["seed"] == 7
        assert request.image.shape == (48, 64, 3)
        question = request.chat["messages"][0]["content"][1]["text"]
        schema = request.chat["response_format"]["json_schema"]["schema"]
        assert list(schema["properties"]) == schema["required"] == list(truth(0))
        assert all(name in question for name in truth(0))


def test_no_more_requests_at_once_than_allowed(bench: Bench) -> None:
    with vlm_server(lambda request, before: Answer(json.dumps(truth(request.frame)), delay=0.05)) as log:
        assert_complete(*bench.run(log.url, concurrency=2))
    assert log.most_at_once == 2


@pytest.mark.parametrize(
    "answer",
    [
        Answer(status=429, headers={"Retry-After": "0"}, body=b'{"error": {"message": "slow down"}}'),
        Answer(status=500, body=b"<html>oops</html>"),
        Answer(status=503, body=b""),
        Answer(body=b'{"choices": [{"message": {"con'),
        Answer(body=b"not json at all"),
        Answer(body=b'{"choices": []}'),
        Answer(json.dumps(truth(0)), announced=100_000),
        Answer(json.dumps(truth(0)), delay=1.2),
        Answer(json.dumps(truth(0)), drip=0.02),
    ],
    ids=["429", "500", "503", "breaks off", "no json", "no choice", "dies half way", "late", "drips"],
)
def test_transient_errors_are_tried_again(bench: Bench, answer: Answer) -> None:
    # On a busy machine a good answer may also be late.
    timeout_s = 0.6 if answer.delay or answer.drip else 30.0
    with vlm_server(first(answer)) as log:
        assert_complete(*bench.run(log.url, timeout_s=timeout_s, concurrency=FRAMES, ATTEMPTS=10))
    assert all(log.frames().count(frame) >= 2 for frame in range(FRAMES))


def test_the_server_says_how_long_to_wait(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    pauses: list[float] = []

    class Recorder:
        def wait(self, seconds: float) -> bool:
            pauses.append(seconds)
            return False

    monkeypatch.setattr(server, "Event", Recorder)
    soon = format_datetime(datetime.now(UTC) + timedelta(hours=1), usegmt=True)
    answers = ["7", soon, "next week", None]

    def script(request: Request, before: int) -> Answer:
        if request.frame or before >= len(answers):
            return answer_truth(request, before)
        header = answers[before]
        return Answer(status=429, headers={"Retry-After": header} if header else {}, body=b"")

    with vlm_server(script) as log:
        assert_complete(*bench.run(log.url, PAUSE_S=1.0, concurrency=1))
    # Seconds; a date in an hour, limited to two minutes; then the doubled back-off of the next tries.
    assert pauses == [7.0, 120.0, 4.0, 8.0]


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ('{"sharpness": 0.5', "no complete JSON object"),
        ("I cannot judge this picture.", "no complete JSON object"),
        ("", "no complete JSON object"),
        (json.dumps({**truth(0), "sharpness": 1.7}), "sharpness lies outside"),
        (json.dumps({**truth(0), "ghosting": -0.1}), "ghosting lies outside"),
        (json.dumps({**truth(0), "ghosting": float("nan")}), "ghosting lies outside"),
        (json.dumps({**truth(0), "texture": "good"}), "texture is not a number"),
        (json.dumps({**truth(0), "texture": True}), "texture is not a number"),
        (json.dumps({**truth(0), "mood": 0.5}), "not asked for"),
        (json.dumps({"sharpness": 0.5}), "lacks structure"),
        (json.dumps(truth(0)) + json.dumps(truth(1)), "differ"),
        ("{" * 3000, "no complete JSON object"),
    ],
)
def test_a_reply_outside_the_schema_is_asked_again(bench: Bench, content: str, complaint: str) -> None:
    with vlm_server(first(Answer(content))) as log:
        assert_complete(*bench.run(log.url))
    again = [request.chat["messages"] for request in log.requests if len(request.chat["messages"]) > 1]
    assert len(again) == FRAMES
    assert all(complaint in messages[-1]["content"] for messages in again)


@pytest.mark.parametrize(
    "words",
    [
        "Here is my judgement:\n```json\n{}\n```\nI hope that helps {{ :-)",
        "<think>Perhaps {}? No.</think>{}",
        "{} and once more {}",
    ],
    ids=["fence", "thoughts", "twice"],
)
def test_text_around_the_object_is_ignored(bench: Bench, words: str) -> None:
    def script(request: Request, before: int) -> Answer:
        return Answer(words.replace("{}", json.dumps(truth(request.frame))))

    with vlm_server(script) as log:
        assert_complete(*bench.run(log.url))
    assert log.frames() == list(range(FRAMES))


def test_an_unscored_frame_is_marked_and_tried_again_later(bench: Bench, tmp_path: Path) -> None:
    def stubborn(request: Request, before: int) -> Answer:
        if request.frame == 2:
            return Answer(json.dumps({**truth(2), "defocus": 5}))
        return Answer(status=500, body=b"") if request.frame == 4 else answer_truth(request, before)

    with vlm_server(stubborn) as log:
        result, rows = bench.run(log.url, ASKS=2, ATTEMPTS=3)
    assert result.missing == ("frame 2 (2.jpg) was not scored", "frame 4 (4.jpg) was not scored")
    assert log.frames() == [0, 1, 2, 2, 3, 4, 4, 4, 5]
    for k in (2, 4):
        scores = {*tables.CUE_COLUMNS, "R", "B", "C", "D", "O", "G", "bin", "Z"}
        assert {rows[k][name] for name in scores} == {None}
        assert (rows[k]["role"], rows[k]["weight"], rows[k]["reliable"]) == ("suppressed", 0.0, False)
    assert cues_of(rows[3]) == true_cues(3)
    supervision = load_supervision(bench.root / "ingest", bench.root / "out", share=0.125)
    assert sorted(supervision.views) == [0, 1, 3, 5], "--allow-partial continues without them"
    assert "frame 2" in bench.remarks.warnings[0] and "defocus lies outside" in bench.remarks.warnings[0]
    assert "frame 4" in bench.remarks.warnings[1] and "500" in bench.remarks.warnings[1]

    with vlm_server() as log:
        assert_complete(*bench.run(log.url))
    assert log.frames() == [2, 4]
    undisturbed = Bench(tmp_path / "undisturbed")
    with vlm_server() as log:
        undisturbed.run(log.url)
    assert bench.bytes() == undisturbed.bytes()


def test_a_server_that_dies_half_way(bench: Bench) -> None:
    """The server stops after the second frame. The next call, with a new server, asks for the others."""
    with vlm_server(dies_with=2) as log:
        result, rows = bench.run(log.url, ATTEMPTS=3, concurrency=1)
    assert len(result.missing) == FRAMES - 2
    assert [k for k, row in rows.items() if row["r_sharpness"] is not None] == [0, 1]
    reasons = [warning for warning in bench.remarks.warnings if "was not scored" in warning]
    assert len(reasons) == FRAMES - 2 and all("no server answers" in reason for reason in reasons)
    port = int(log.url.partition("127.0.0.1:")[2].partition("/")[0])
    with vlm_server(port=port) as log:
        assert_complete(*bench.run(log.url))
    assert log.frames() == [2, 3, 4, 5]


def test_a_stage_without_any_score_fails(bench: Bench) -> None:
    with socket.socket() as place:
        place.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{place.getsockname()[1]}/v1"
    with pytest.raises(StageError, match="scored no frame: no server answers"):
        bench.run(url, ATTEMPTS=1)
    assert not list((bench.root / "out").iterdir())


def test_a_damaged_cache_file_is_replaced(bench: Bench) -> None:
    with vlm_server() as log:
        bench.run(log.url)
        torn, wild, *_ = sorted((bench.root / "kept").iterdir())
        torn.write_text('{"r_sharpness": 0.5')
        wild.write_text(wild.read_text().replace('"r_sharpness": ', '"r_sharpness": 3'))
        assert_complete(*bench.run(log.url))
    assert len(log.requests) == FRAMES + 2


def test_cached_scores_are_for_the_same_question_only(bench: Bench) -> None:
    with vlm_server() as log:
        for settings in ({}, {"model": "other"}, {"max_tokens": 64}, {"concurrency": 1}):
            bench.run(log.url, **settings)
    assert len(log.requests) == 3 * FRAMES


def test_a_server_without_structured_output(bench: Bench) -> None:
    def old(request: Request, before: int) -> Answer:
        if "response_format" in request.chat:
            return Answer(status=400, body=b'{"error": "unknown field response_format"}')
        return answer_truth(request, before)

    with vlm_server(old) as log:
        assert_complete(*bench.run(log.url, concurrency=1))
    assert sum("response_format" in request.chat for request in log.requests) == 1


def test_a_refused_frame_does_not_end_the_others(bench: Bench) -> None:
    def narrow(request: Request, before: int) -> Answer:
        refusal = Answer(status=400, body=b'{"error": {"message": "image too large"}}')
        return refusal if request.frame == 1 else answer_truth(request, before)

    with vlm_server(narrow) as log:
        result, _ = bench.run(log.url, concurrency=1)
    assert result.missing == ("frame 1 (1.jpg) was not scored",)
    assert "image too large" in bench.remarks.warnings[0]
    assert all("response_format" in request.chat for request in log.requests if request.frame != 1)


@pytest.mark.parametrize(("status", "remedy"), [(401, "API_KEY"), (403, "API_KEY"), (404, "qwen.model")])
def test_an_error_for_all_frames_ends_the_stage(bench: Bench, status: int, remedy: str) -> None:
    echo = json.dumps({"error": {"message": f"not with {KEY}"}}).encode()
    with (
        vlm_server(lambda request, before: Answer(status=status, body=echo)) as log,
        pytest.raises(StageError, match=str(status)) as caught,
    ):
        bench.run(log.url, concurrency=1)
    assert remedy in caught.value.hint
    assert KEY not in str(caught.value) + caught.value.hint
    assert len(log.requests) <= 2


def test_the_key_is_not_sent_to_another_host(bench: Bench) -> None:
    with vlm_server() as other:
        moved = Answer(status=307, headers={"Location": f"{other.url}/chat/completions"}, body=b"")
        with vlm_server(lambda request, before: moved) as log, pytest.raises(StageError, match="moved"):
            bench.run(log.url)
    assert other.requests == []


def test_without_the_client(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("httpx2", "cleargs.rva.vlm.server", "cleargs.rva.vlm.evaluator"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, "httpx2", None)
    with pytest.raises(InputError, match="httpx2") as caught:
        bench.run("http://127.0.0.1:9/v1")
    assert "cleargs[server]" in caught.value.hint


def test_no_key_no_header(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CLEARGS_VLM_API_KEY")
    with vlm_server() as log:
        bench.run(log.url)
    assert all("Authorization" not in request.headers for request in log.requests)


def test_a_key_that_is_invalid_in_a_header(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CLEARGS_VLM_API_KEY", "sk-one\nsk-two")
    with pytest.raises(InputError, match="characters that are invalid in a key") as caught:
        bench.run("http://127.0.0.1:9/v1")
    assert "sk-one" not in str(caught.value)


@pytest.mark.parametrize(
    "url",
    ["127.0.0.1:8000", "ftp://host/v1", "http://", "http://me:sesame@host/v1", "http://host/v1?key=sesame"],
)
def test_invalid_addresses(bench: Bench, monkeypatch: pytest.MonkeyPatch, url: str) -> None:
    """They are refused before anything is written, and not quoted, since they may contain a password."""
    settings = {"rva": {"evaluator": "qwen3-vl", "qwen": {"model": MODEL, "base_url": url}}}
    with pytest.raises(ConfigError, match="base_url") as caught:
        check_document(two_stages(), settings)
    assert "sesame" not in str(caught.value) + caught.value.hint
    monkeypatch.setenv("CLEARGS_VLM_URL", url)
    with pytest.raises(InputError, match="base_url") as met:
        bench.run("")
    assert "sesame" not in str(met.value) + met.value.hint


def test_from_the_command_line(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Model and address come from the environment. The key is in no file and in no output."""
    monkeypatch.setenv("CLEARGS_VLM_MODEL", MODEL)
    monkeypatch.delenv("CLEARGS_STORE", raising=False)
    folder, recipe = tmp_path / "run", tmp_path / "empty.toml"
    recipe.touch()
    (tmp_path / "source").mkdir()

    def run() -> int:
        given = ["run", str(tmp_path / "source"), "-o", str(folder), "--workflow", str(recipe)]
        given += ["--set", "rva.evaluator=qwen3-vl", "--debug"]
        monkeypatch.setattr(server, "_ATTEMPTS", 1)
        return invoke(given, two_stages())

    def failing(request: Request, before: int) -> Answer:
        body = f"no: {request.headers['Authorization']}".encode()
        return Answer(status=500, body=body) if request.frame == 3 else answer_truth(request, before)

    with vlm_server(failing) as log:
        monkeypatch.setenv("CLEARGS_VLM_URL", log.url)
        assert run() == 3
    with vlm_server() as log:
        monkeypatch.setenv("CLEARGS_VLM_URL", log.url)
        assert run() == 0
        assert log.frames() == [3]
        assert run() == 0
        assert log.frames() == [3], "a finished stage sends no requests"
    with vlm_server(lambda request, before: Answer(status=401, body=KEY.encode())) as log:
        monkeypatch.setenv("CLEARGS_VLM_URL", log.url)
        monkeypatch.setenv("CLEARGS_VLM_MODEL", "other")
        assert run() == 1
    shown = capsys.readouterr()
    assert "missing: rva: frame 3 (3.jpg) was not scored" in shown.err and "***" in shown.err
    written = [file for file in folder.rglob("*") if file.is_file()]
    assert f'model = "{MODEL}"' not in (folder / "run.toml").read_text(), "the last call named another model"
    assert any(MODEL.encode() in file.read_bytes() for file in written if file.name == "manifest.json")
    for text in (shown.out.encode(), shown.err.encode(), *(file.read_bytes() for file in written)):
        assert KEY.encode() not in text


def test_the_model_must_be_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CLEARGS_VLM_MODEL", raising=False)
    with pytest.raises(ValueError, match=r"needs qwen\.model"):
        RvaConfig.model_validate({"evaluator": "qwen3-vl", "qwen": {}})
    assert RvaConfig.model_validate({"qwen": {}}).qwen.model == ""


def test_the_prompt_changes_with_its_version_only() -> None:
    """If you change a word, raise QwenConfig.prompt and update the digest here."""
    import hashlib

    from cleargs.rva.config import QwenConfig
    from cleargs.rva.vlm.prompt import prompt_text, reply_schema

    parts = [prompt_text(masked=False), prompt_text(masked=True), json.dumps(reply_schema())]
    digest = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
    assert (QwenConfig.prompt, digest) == (1, "eaab1435dd11ef4c")
