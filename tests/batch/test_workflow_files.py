"""The files that Snakemake reads: installed with the package, and in step with the stages."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from cleargs.batch.resources import GPU_STAGES, Wanted, resources
from cleargs.batch.slurm_watch import PATIENCE
from cleargs.pipeline.dag import installed

ROOT = Path(__file__).parents[2]
SLURM = (ROOT / "workflows" / "profiles" / "slurm" / "config.yaml").read_text()


def test_all_of_them_are_installed() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    patterns = settings["package-data"]["cleargs.workflows"]
    installed_files = {file for pattern in patterns for file in (ROOT / "workflows").glob(pattern)}
    there = {
        file
        for file in (ROOT / "workflows").rglob("*")
        if file.is_file() and file.suffix not in (".py", ".pyc")
    }
    assert there == installed_files


def test_the_stages_that_use_a_gpu_are_one_job() -> None:
    """They follow each other: what leaves the group and comes back would make Snakemake see a circle."""
    grouped = re.findall(r"(\w+)=scene", SLURM)
    names = installed().names
    assert tuple(grouped) == GPU_STAGES == names[names.index(grouped[0]) :]


def test_on_a_gpu_all_stages_but_the_first_ask_for_one() -> None:
    names = installed().names
    assert [resources(name, None, Wanted(), "cuda").gpu for name in names] == [0, 1, 1, 1, 1]
    assert [resources(name, None, Wanted(), "cpu").gpu for name in names] == [0, 0, 0, 0, 0]
    assert [resources("g0", None, Wanted(gpus=gpus), "cuda").gpu for gpus in (0, 2)] == [0, 2]


def test_the_warning_leaves_time_for_a_checkpoint() -> None:
    found = re.search(r"--signal=TERM@(\d+)", SLURM)
    assert found is not None and int(found[1]) >= PATIENCE + 20
