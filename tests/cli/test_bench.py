"""The bench command reports every part of an iteration."""

from __future__ import annotations

import json

import pytest

from cleargs.cli.main import main


def test_bench_train_reports_each_part(capsys: pytest.CaptureFixture[str]) -> None:
    size = ["--gaussians", "50", "--width", "33", "--height", "17", "--threads", "1", "--repeats", "1"]
    with pytest.raises(SystemExit) as end:
        main(["bench", "train", *size, "--json"])
    assert end.value.code == 0
    row = json.loads(capsys.readouterr().out)
    parts = [row[name] for name in ("forward", "loss", "backward", "adam")]
    assert row["gaussians"] == 50 and min(parts) > 0 and row["iteration"] >= max(parts)
