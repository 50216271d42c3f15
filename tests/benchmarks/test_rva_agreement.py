"""Agreement of evaluators: figures by hand, and the command, which must not change the run."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from rva_scenes import uniform_cues
from vlm_server import FRAMES, Answer, Request, truth, two_stages, vlm_server

from benchmarks.commands import invoke
from benchmarks.rva.agreement import EvaluatorCues, compare, spearman
from cleargs.cli.main import invoke as cleargs
from cleargs.rva.tables import CUE_COLUMNS
from cleargs.stages.rva import RvaConfig


def test_spearman_by_hand() -> None:
    rising = np.array([0.1, 0.2, 0.3, 0.9])
    assert spearman(rising, rising**3) == 1.0
    assert spearman(rising, -rising) == -1.0
    # Ranks 1 2 3 4 against 2 1 3 4: 1 - 6 (1 + 1) / (4 * 15)
    assert spearman(rising, np.array([0.2, 0.1, 0.3, 0.9])) == pytest.approx(0.8)
    # Ranks 1 2 3 4 against 1.5 1.5 3.5 3.5: cov 4, var 5 and 4
    assert spearman(rising, np.array([0.0, 0.0, 1.0, 1.0])) == pytest.approx(4 / 20**0.5, abs=1e-6)
    assert spearman(rising, np.full(4, 0.5)) is None
    assert spearman(rising[:1], rising[:1]) is None


def test_widest_gaps_come_first_without_unscored_frames() -> None:
    R = [0.9, 0.8, 0.7, 0.6, 0.5]
    first = EvaluatorCues("a", uniform_cues(R, [0.1] * 5))
    second = EvaluatorCues("b", uniform_cues([0.5, 0.8, 0.7, 0.6, 0.9], [0.1] * 5))
    agreement = compare(first, second, RvaConfig(), most=1)
    (worst,) = agreement.disagreements
    assert (worst.row, worst.gap, worst.rank) == (0, 1.0, (1, 5))  # ties go to the earlier frame
    assert list(worst.R) == pytest.approx([0.9, 0.5])
    # Ranks 5 4 3 2 1 against 1 4 3 2 5: 1 - 6 (16 + 16) / (5 * 24)
    assert agreement.spearman["R"] == pytest.approx(-0.6)
    assert agreement.spearman["B"] is None
    # tau_R is 0.70: the first relies on frames 0 1 2, the second on 1 2 4.
    assert agreement.reliable == {"both": 2, "first_only": 1, "second_only": 1, "neither": 1}

    second.cues[0] = np.nan
    agreement = compare(first, second, RvaConfig(), most=9)
    assert agreement.frames == 4
    assert [d.row for d in agreement.disagreements] == [4, 1, 2, 3]
    assert agreement.disagreements[0].rank == (4, 1)


def test_equal_evaluators_have_no_disagreements() -> None:
    same = EvaluatorCues("a", uniform_cues([0.9, 0.2], [0.1, 0.8]))
    agreement = compare(same, same, RvaConfig(), most=9)
    assert agreement.disagreements == () and agreement.spearman["B"] == 1.0
    nothing = EvaluatorCues("b", np.full((2, len(CUE_COLUMNS)), np.nan))
    assert compare(same, nothing, RvaConfig(), most=9).frames == 0


class Shell:
    """A run with the evaluator ``statistics``, and ``agree`` on it."""

    def __init__(self, root: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.folder = root / "run"
        self.capsys = capsys
        self.recipe = root / "empty.toml"
        self.recipe.touch()
        self.source = root / "source"
        self.source.mkdir()
        assert self.run() == 0

    def run(self, *settings: str) -> int:
        given = ["run", str(self.source), "-o", str(self.folder), "--workflow", str(self.recipe)]
        code = cleargs([*given, *(part for text in settings for part in ("--set", text))], two_stages())
        self.capsys.readouterr()
        return code

    def agree(self, evaluators: str, *options: str) -> tuple[int, str, str]:
        code = invoke(["rva", "agree", str(self.folder), "--evaluators", evaluators, *options], two_stages())
        streams = self.capsys.readouterr()
        return code, streams.out, streams.err

    def files(self) -> dict[str, bytes]:
        """Files of the run, except those of ``agree``."""
        return {
            str(file.relative_to(self.folder)): file.read_bytes()
            for file in self.folder.rglob("*")
            if file.is_file() and "agree" not in file.relative_to(self.folder).parts
        }


@pytest.fixture
def shell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Shell:
    for name in ("CLEARGS_STORE", "CLEARGS_VLM_API_KEY", "CLEARGS_VLM_URL"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("CLEARGS_VLM_MODEL", "qwen3-vl:8b")
    return Shell(tmp_path, capsys)


def test_agree_does_not_change_the_run(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    before = shell.files()
    with vlm_server() as log:
        monkeypatch.setenv("CLEARGS_VLM_URL", log.url)
        code, out, _ = shell.agree("statistics,qwen3-vl", "--json")
        assert code == 0 and len(log.requests) == FRAMES
        assert shell.agree("statistics,qwen3-vl", "--json")[:2] == (0, out)
        assert len(log.requests) == FRAMES, "scored once"
    assert shell.files() == before
    document = json.loads(out)
    assert json.loads((shell.folder / "agree" / "agreement.json").read_text()) == document
    (pair,) = document["pairs"]
    assert pair["evaluators"] == ["statistics-2", "qwen3-vl:qwen3-vl:8b:prompt-1"]
    assert pair["frames"] == FRAMES
    assert set(pair["spearman"]) == {"R", "B", "R-B", *CUE_COLUMNS}
    gaps = [item["gap"] for item in pair["disagreements"]]
    assert gaps == sorted(gaps, reverse=True) and gaps[0] > 0
    sheet = cv2.imread(pair["sheet"])
    assert sheet is not None and sheet.std() > 0


def test_agree_prints_a_report_for_models(shell: Shell) -> None:
    """The two models rank the frames in opposite orders."""

    def script(request: Request, before: int) -> Answer:
        frame = request.frame if request.chat["model"] == "up" else FRAMES - 1 - request.frame
        return Answer(json.dumps(truth(frame)))

    with vlm_server(script) as log:
        address = ("--set", f"rva.qwen.base_url={log.url}")
        code, out, _ = shell.agree("qwen3-vl:up,qwen3-vl:down,statistics", *address, "--most", "2")
    assert code == 0
    assert "qwen3-vl:up:prompt-1 | qwen3-vl:down:prompt-1: 6 of 6 frames" in out
    assert "R                      -1.000" in out
    assert "frame     0  gap 1.00  R 0.95 | 0.20" in out
    assert sum(line.startswith("picture: ") for line in out.splitlines()) == 3


def test_agree_reuses_the_scores_of_the_run(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    with vlm_server() as log:
        monkeypatch.setenv("CLEARGS_VLM_URL", log.url)
        assert shell.run("rva.evaluator=qwen3-vl") == 0
    code, out, _ = shell.agree("qwen3-vl,statistics", "--json")
    assert code == 0, "no server was needed"
    assert json.loads(out)["pairs"][0]["evaluators"][0] == "qwen3-vl:qwen3-vl:8b:prompt-1"


def test_agree_names_frames_without_score(shell: Shell) -> None:
    def script(request: Request, before: int) -> Answer:
        return Answer(json.dumps(truth(request.frame)) if request.frame != 2 else "no")

    with vlm_server(script) as log:
        code, out, err = shell.agree("statistics,qwen3-vl", "--set", f"rva.qwen.base_url={log.url}")
    assert code == 3
    assert "5 of 6 frames scored by both" in out and "did not score 2" in err


@pytest.mark.parametrize(
    ("evaluators", "words"),
    [
        ("statistics", "at least two"),
        ("statistics,oracle", "rva.evaluator"),
        ("statistics,statistics", "two"),
    ],
)
def test_agree_refuses_bad_evaluators(shell: Shell, evaluators: str, words: str) -> None:
    code, _, err = shell.agree(evaluators)
    assert code == 2 and words in err


def test_agree_needs_a_run(shell: Shell, tmp_path: Path) -> None:
    assert invoke(["rva", "agree", str(tmp_path), "--evaluators", "a,b"], two_stages()) == 2
