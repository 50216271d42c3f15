"""`python -m benchmarks evidence`: the fixed list, the page, and a tiny page that is resumed."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.commands import invoke
from benchmarks.comparison import results_page as results
from benchmarks.comparison.cells import Cell
from benchmarks.comparison.evidence import EvidenceContext, estimate_minutes, read_evidence
from benchmarks.comparison.front_page import FAULTS, fault_rows, fault_table, plot_gains, with_block
from benchmarks.comparison.origin import version_of_source
from benchmarks.comparison.results_page import Origin, losses, section_page, summary_page
from benchmarks.comparison.saved_sections import SavedSection
from benchmarks.comparison.scenes import Sample, SceneRecipe
from benchmarks.comparison.variants import QUESTIONS, VARIANTS, find_variants
from cleargs.errors import ConfigError, InputError
from cleargs.evaluate.config import EvalOptions
from cleargs.media.image import read_rgb
from cleargs.pipeline.session import opened_store
from cleargs.pipeline.stages import installed
from cleargs.progress import SilentReporter

TINY = """
[test]
rooms = [100, 101]
protocols = ["mixed", "flood"]
worlds = []
videos = ["kitchen"]

[tuning]
rooms_below = 100

[[quick]]
name = "rooms"
title = "Motion blur"
kind = "rooms"
protocols = ["mixed", "flood"]
seeds = [100]
frames = 6
size = [96, 54]
steps = 24
factors = [1, 2]
variants = ["all-view", "full"]
settings = ["g0.min_points=400", "g0.budget=500", "ingest.max_features=512", "rivr.rounds=1"]

[[quick]]
name = "aligned"
title = "Motion blur, colours aligned"
kind = "rooms"
protocols = ["mixed"]
seeds = [100]
frames = 6
size = [96, 54]
steps = 24
variants = ["all-view", "full"]
settings = ["g0.min_points=400", "g0.budget=500", "ingest.max_features=512", "rivr.rounds=1"]
align_colour = true

[[quick]]
name = "videos"
title = "Real videos"
kind = "video"
captures = ["kitchen"]
seeds = [0]
frames = 6
size = [96, 54]
steps = 24
variants = ["all-view", "full"]

[[full]]
name = "rooms"
title = "Rooms"
kind = "rooms"
protocols = ["mixed"]
seeds = [100]
frames = 6
size = [96, 54]
steps = 24
variants = ["all-view"]
"""
ORIGIN = Origin("python -m benchmarks evidence -o OUT", "default", False, read_evidence().quick)


def test_test_set_and_tuning_set_are_disjoint() -> None:
    evidence = read_evidence()
    assert min(evidence.test.rooms) >= evidence.tuning.rooms_below == 100
    for section in (*evidence.quick, *evidence.full):
        find_variants(section.variants)
        if section.kind != "video":
            assert set(section.seeds) <= set(evidence.test.rooms)
    for sections in (evidence.quick, evidence.full):
        assert len({section.name for section in sections}) == len(sections)
        assert {"all-view", "rva", "formation", "full"} <= set(sections[0].variants)
        assert len(sections[0].seeds) >= 5  # the first claims of the page need several samples


@pytest.mark.parametrize(
    ("old", "new", "cause"),
    [
        ("rooms = [100, 101]", "rooms = [99, 100]", "tuning set"),
        ("seeds = [100]", "seeds = [7]", "7 is not in the test set"),
        ('captures = ["kitchen"]', 'captures = ["garden"]', "garden is not in the test set"),
        ("frames = 6", "pictures = 6", "quick.0"),
    ],
)
def test_list_that_breaks_its_rules_is_refused(old: str, new: str, cause: str, tmp_path: Path) -> None:
    path = tmp_path / "list.toml"
    path.write_text(TINY.replace(old, new, 1))
    with pytest.raises(ConfigError, match=cause):
        read_evidence(path)


def test_shared_work_counts_once_in_the_estimate(tmp_path: Path) -> None:
    blur = read_evidence().quick[0]
    with opened_store(tmp_path / "store") as store:
        recipe = SceneRecipe(installed(), "default", (), "cpu", 2, EvalOptions())
        context = EvidenceContext(tmp_path, None, recipe, store, SilentReporter())
        alone, again, more = estimate_minutes(
            [blur, blur, blur.model_copy(update={"variants": (*blur.variants, "rivr")})], context
        )
        assert again == 0.0 and 0.0 < more < alone / len(blur.variants)
        (twice,) = estimate_minutes(
            [blur.model_copy(update={"seeds": (*blur.seeds, 105, 106, 107, 108, 109)})], context
        )
        assert twice == pytest.approx(2 * alone)


def test_template_contains_no_number() -> None:
    template = Path(results.__file__).with_name("results.md").read_text(encoding="utf-8")
    # Digits within names (G0, 3DGS, gs2e-medium) do not count.
    assert re.findall(r"(?<![\w.-])\d[\d.,]*(?![\w-])", template) == []


def test_questions_name_variants() -> None:
    names = {variant.name for variant in VARIANTS}
    assert {name for _, *asked in QUESTIONS for name in asked} <= names


def cell(variant: str, sample: str, psnr: float, lpips: float) -> Cell:
    return Cell(
        column="mixed",
        sample=sample,
        variant=variant,
        views="observed",
        means={"psnr": psnr, "lpips_vgg": lpips},
        images=4,
        seconds=2.0,
        shared_seconds=1.0,
        gaussians=10,
        steps=100,
        sh_degree=1,
        cpu_seconds=4.0,
        peak_memory_gb=0.5,
        evaluation=f"evaluations/{variant}-{sample}-{psnr}",
    )


def found(*gains: float, version: str = "0.1.0, abc") -> SavedSection:
    """The whole method gains ``gains`` dB of PSNR per sample, and about 0.1 of LPIPS in each."""
    cells = []
    for number, gain in enumerate(gains):
        cells.append(cell("all-view", f"s{number}", 20.0 + number, 0.4))
        cells.append(cell("full", f"s{number}", 20.0 + number + gain, 0.3 + 0.001 * number))
    (section, *_) = read_evidence().quick
    return SavedSection(
        section=section,
        version=version,
        machine="cpu, 2 threads",
        missing=("phone: no protocol is called 'phone'",),
        cells=tuple(cells),
        roles=(),
        choices=(),
    )


def test_losses_are_sorted_by_significance() -> None:
    ((section, loss),) = losses([found(-1.0, -1.1, -0.9)])
    assert section == "Motion blur"
    assert (loss.against, loss.metric, loss.significance) == ("all-view", "psnr", "significant")
    ((_, chance),) = losses([found(-1.0, 0.5, -0.2)])
    assert chance.significance == "none"
    ((_, single),) = losses([found(-1.0)])
    assert single.significance == "one sample"
    assert losses([found(1.0, 1.1, 0.9)]) == []
    ordered = [
        loss.significance for _, loss in losses([found(-1.0, 0.5), found(-1.5), found(-1.0, -1.1, -0.9)])
    ]
    assert ordered == ["significant", "one sample", "none"]


def test_scenes_shared_by_sections_count_once() -> None:
    whole, part, other = found(-1.0, -1.1, -0.9), found(-1.0), found(-2.0)
    assert len(losses([whole, whole, part])) == 1
    assert len(losses([whole, other])) == 2
    page = summary_page([whole, part], ORIGIN)
    assert "Worse in 1 of 2 comparisons, significantly in 1 of them." in page
    assert "| the whole method, against all-view training | 0 / 1 / 0 | not made |" in page


def test_aligned_sections_do_not_count() -> None:
    plain, again = found(-1.0, -1.1, -0.9), found(-2.0, -2.1, -1.9)
    again = again.model_copy(update={"section": plain.section.model_copy(update={"align_colour": True})})
    assert losses([plain, again]) == losses([plain])


def test_page_of_a_few_cells() -> None:
    saved = found(-1.0, -1.1, -0.9)
    page, own = summary_page([saved], ORIGIN), section_page(saved, ORIGIN)
    assert "Worse in 1 of 2 comparisons, significantly in 1 of them." in page
    row = "| Motion blur | mixed | At the input's true poses | all-view G0 | **-1.00 ± 0.25** |  |  |  |"
    assert row in page
    assert page.index(row) < page.index("## In short")
    assert "| [Motion blur](blur.md) | mixed | 600 | 0.1.0, abc |" in page
    assert (
        "| the whole method, against all-view training | 0 / 1 / 0 | not made | not made | 1 / 0 / 0 |"
        in page
    )
    assert "* phone: no protocol is called 'phone'" in own and "Made by version 0.1.0, abc." in own
    assert "`python -m benchmarks evidence -o OUT --section blur`, version 0.1.0, abc" in page
    assert "`python -m benchmarks evidence -o OUT --section blur`, version 0.1.0, abc" in own
    assert "LPIPS (AlexNet) could not be measured" in page
    assert own.startswith("# Motion blur\n") and "| mixed (n = 3) |" in own
    assert "another list" not in page + own
    assert "@" not in page, "all placeholders of the template are filled"


def test_page_shows_a_section_without_results() -> None:
    nothing = found().model_copy(update={"missing": ("kitchen: it is not there",)})
    page = section_page(nothing, ORIGIN)
    assert "* kitchen: it is not there" in page and "No result of this section could be made" in page


def test_page_names_its_sections_and_versions() -> None:
    other = read_evidence().quick[1]
    pair = [found(1.0), found(2.0, version="0.2.0, def").model_copy(update={"section": other})]
    page = summary_page(pair, ORIGIN)
    absent = [section.title for section in ORIGIN.sections if section not in (pair[0].section, other)]
    assert f"**Not made yet: {', '.join(absent)}.**" in page
    command = "`python -m benchmarks evidence -o OUT --section blur --section mixed`"
    command += ", version 0.1.0, abc and 0.2.0, def"
    assert page.count(command) == 2, "under the losses and under the answers"
    own = "`python -m benchmarks evidence -o OUT --section mixed`, version 0.2.0, def"
    assert own in section_page(pair[1], ORIGIN)
    alone = replace(ORIGIN, sections=(pair[0].section, other))
    whole = summary_page(pair, alone)
    assert "Not made yet" not in whole and "`python -m benchmarks evidence -o OUT`, version 0.1.0" in whole


def test_section_of_an_older_list_is_named() -> None:
    saved = found(1.0)
    older = saved.model_copy(update={"section": saved.section.model_copy(update={"steps": 999})})
    assert "another list of captures" in section_page(older, ORIGIN)
    assert "0.1.0, abc (another list)" in summary_page([older], ORIGIN)


def test_front_page_names_faults_in_words(tmp_path: Path) -> None:
    saved = found(2.0, 2.1, 1.9)
    section = saved.section.model_copy(update={"name": "default-length"})
    cells = tuple(
        one.model_copy(update={"means": one.means | {"lpips_alex": one.means["lpips_vgg"]}})
        for one in saved.cells
    )
    saved = saved.model_copy(update={"section": section, "cells": cells})
    table = fault_table([saved])
    assert f"| {FAULTS['mixed']} | 21.0 / 0.400 | 23.0 / 0.301 | **+2.0 ± 0.2** |" in table
    assert "Version 0.1.0, abc." in table and "| mixed |" not in table
    assert fault_table([found(2.0)]) == "", "other sections are on their own pages only"
    plot_gains(tmp_path / "gains.png", fault_rows([saved]))
    assert read_rgb(tmp_path / "gains.png").std() > 10


def test_faults_have_words_for_every_protocol_of_the_test_set() -> None:
    assert set(read_evidence().test.protocols) == FAULTS.keys()


def test_table_goes_between_its_lines() -> None:
    page = "# Title\n\n<!-- faults -->\nold\n<!-- /faults -->\n\nrest\n"
    new = with_block(page, "faults", "| a |")
    assert new == "# Title\n\n<!-- faults -->\n\n| a |\n\n<!-- /faults -->\n\nrest\n"
    assert with_block(new, "faults", "| a |") == new
    with pytest.raises(InputError, match="no place"):
        with_block(page, "real", "| a |")


def test_version_contains_a_digest_of_the_source() -> None:
    assert re.search(r"source [0-9a-f]{12}$", version_of_source())
    assert version_of_source() == version_of_source()


def make(out: Path, spec: Path, *more: str) -> int:
    return invoke(["evidence", "-o", str(out), "--quick", "--list", str(spec), "--quiet", *more])


@pytest.mark.slow
def test_tiny_page_is_made_and_resumed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spec, out = tmp_path / "list.toml", tmp_path / "out"
    spec.write_text(TINY)
    assert make(out, spec, "--dry-run") == 0
    assert "min  on two idle cores" in capsys.readouterr().out and not (out / "captures").exists()
    # An interrupted call leaves a capture under a temporary name, which does not count as complete.
    (out / "captures" / ".1-mixed-6x96x54-100" / "images").mkdir(parents=True)
    assert make(out, spec) == 3, "partial: a protocol and a video are missing"
    pages = read_pages(out)
    assert pages.keys() == {"all.md", "rooms.md", "aligned.md", "videos.md"}
    assert "* flood: no protocol is called 'flood'" in pages["rooms.md"]
    assert "* kitchen: this real capture needs --captures" in pages["videos.md"]
    assert "| mixed 1x | mixed 2x |" in pages["rooms.md"]
    assert "| all-view G0 | 24 to 48 |" in pages["rooms.md"] and "| ClearGS | 24 to 48 |" in pages["rooms.md"]
    assert "fitted to the truth (affine in sRGB) before measuring." in pages["aligned.md"]
    plain, aligned = (
        SavedSection.model_validate_json((out / f"results/{name}.json").read_bytes())
        for name in ("rooms", "aligned")
    )
    scenes = {(one.sample, one.variant, one.views): one for one in plain.cells if one.column == "mixed 1x"}
    for one in aligned.cells:
        same = scenes[one.sample, one.variant, one.views]
        assert one.steps == same.steps and one.gaussians == same.gaussians
        assert (one.means["psnr"] or 0.0) > (same.means["psnr"] or 0.0)
    for name in ("results/rooms.png", "results/rooms-sheet.jpg", "results/rooms.json"):
        assert (out / name).stat().st_size > 0
    stored = {path: path.stat().st_mtime_ns for path in out.rglob("manifest.json")}
    assert make(out, spec) == 3
    assert stored == {path: path.stat().st_mtime_ns for path in out.rglob("manifest.json")}
    assert read_pages(out) == pages

    # A call for one section, or for none, writes the others from results/.
    for more, code in (("--section", "videos"), 3), (("--rewrite",), 0):
        for path in (out / "results").glob("*.md"):
            path.unlink()
        assert make(out, spec, *more) == code
        assert read_pages(out) == pages
    spec.write_text(TINY.replace("steps = 24", "steps = 25", 1))
    capsys.readouterr()
    assert make(out, spec, "--rewrite") == 0
    assert "rooms.json was made from another list of evidence" in capsys.readouterr().err
    assert "(another list)" in read_pages(out)["all.md"]


def read_pages(out: Path) -> dict[str, str]:
    """Return the pages in ``results/`` by name."""
    return {path.name: path.read_text() for path in (out / "results").glob("*.md")}


def test_list_that_is_a_pipe_or_too_deep_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.toml")
    (tmp_path / "deep.toml").write_text("[" * 200_000)
    for name in ("pipe", "deep"):
        with pytest.raises(ConfigError):
            read_evidence(tmp_path / f"{name}.toml")
        note = tmp_path / name / "truth" / "capture.json"
        note.parent.mkdir(parents=True)
        (tmp_path / f"{name}.toml").rename(note)
        assert Sample(tmp_path / name, 0, None).column == name
