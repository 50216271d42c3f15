"""All variants train on the same frames, with equal steps and budget; names of captures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.comparison import pictures
from benchmarks.comparison.equal_work import EqualWork, Steps, split_steps, steps_of, variant_config
from benchmarks.comparison.scenes import capture_name
from benchmarks.comparison.variants import VARIANTS, WHOLE, Variant
from cleargs.errors import ConfigError
from cleargs.media.image import write_rgb
from cleargs.pipeline.config import load_config
from cleargs.pipeline.stages import installed


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: variant.name)
def test_settings_of_every_variant_are_valid(variant: Variant) -> None:
    plain = load_config(installed(), "default", seed=0)
    changes = bool(variant.overrides or variant.workflow)
    assert (variant_config(installed(), variant, "default", (), 0) != plain) == changes


def test_every_variant_has_the_same_images() -> None:
    found = [variant_config(installed(), v, "default", ("ingest.max_size=320",), 0) for v in VARIANTS]
    images = [config.sections["ingest"].model_copy(update={"rolling_shutter": True}) for config in found]
    assert all(settings == images[0] for settings in images)


def test_cameras_have_a_readout_only_where_the_training_renders_it() -> None:
    for variant in VARIANTS:
        sections = variant_config(installed(), variant, "default", (), 0).sections
        assert sections["ingest"].rolling_shutter == sections["g0"].formation.enabled, variant.name


@pytest.mark.parametrize("recipe", ["default", "smoke", "paper"])
@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: variant.name)
def test_every_variant_has_the_same_steps(variant: Variant, recipe: str) -> None:
    plain = load_config(installed(), recipe)
    for total in (steps_of(plain, 20).total, 1000, 7777):
        work = EqualWork(steps=total, frames=20, budget=12_345, sh_degree=2)
        config = variant_config(installed(), variant, recipe, (), 0, work)
        assert steps_of(config, 20, variant.stage).total == total
        g0, rivr = config.sections["g0"], config.sections["rivr"]
        later = [stage.distil.applied_to(g0, 20) for stage in (rivr, config.sections["consolidate"])]
        assert (g0.budget, g0.sh_degree) == (12_345, 2)
        made = [g0, *later][: ("g0", "rivr", "consolidate").index(variant.stage) + 1]
        assert [made[0].begin, *(later.begin for later in made[1:]), 1.0] == [
            0.0,
            *(training.end for training in made),
        ]
        if variant.stage != "g0":
            made[1] = rivr.distillation(g0, rivr.rounds, 0, rivr.distil.steps, 20)
        assert {training.planned for training in made} == {total}


def test_total_of_the_recipe_keeps_its_steps() -> None:
    full = next(variant for variant in VARIANTS if variant.name == WHOLE)
    plain = load_config(installed(), "default", seed=0)
    work = EqualWork(steps_of(plain, 20).total, 20, budget=40_000, sh_degree=1)
    same = (
        "g0.sh_degree=1",
        "g0.budget=40000",
        *(
            "g0.steps=2400",
            "rivr.distil.steps=150",
            "consolidate.distil.steps=150",
        ),  # the minimum steps of the recipe
    )
    assert variant_config(installed(), full, "default", (), 0, work) == load_config(
        installed(), "default", same, 0
    )


def test_steps_are_split_in_proportion() -> None:
    whole = Steps(g0=2000, round=600, rounds=2, consolidate=600)
    assert split_steps(whole, "consolidate", 7600) == Steps(4000, 1200, 2, 1200)
    assert split_steps(whole, "g0", 3800) == Steps(3800, 0, 0, 0)
    # Without consolidation its 600 steps go to the two rounds.
    assert split_steps(whole, "rivr", 3800) == Steps(2000, 900, 2, 0)
    with pytest.raises(ConfigError, match="too few"):
        split_steps(whole, "consolidate", 3)


def test_dot_in_a_folder_name_is_not_a_suffix(tmp_path: Path) -> None:
    (tmp_path / "scan.2024-05-01").mkdir()
    assert capture_name(tmp_path / "scan.2024-05-01") == "scan.2024-05-01"
    assert capture_name(tmp_path / "walk.mp4") == "walk"


def test_brackets_in_a_name_are_not_a_pattern(tmp_path: Path) -> None:
    name = "Walk [dQw4w9WgXcQ]_000012"
    write_rgb(tmp_path / f"{name}.png", np.full((4, 4, 3), 51, np.uint8))
    found = pictures.find_image(tmp_path, name)
    assert found is not None and np.allclose(found, 0.2)
