"""References whose poses are in other units than the run's input."""

from __future__ import annotations

import numpy as np
import pytest

from cleargs.capture.cameras import Pose
from cleargs.errors import InputError
from cleargs.evaluate.alignment import require_one_unit


def walk(factor: float, count: int = 8) -> list[Pose]:
    """Cameras on an arc, with lengths times ``factor``."""
    angles = np.linspace(0, 2, count)
    centres = factor * np.stack([np.cos(angles), 0.1 * np.sin(3 * angles), np.sin(angles)], axis=1)
    return [Pose(np.eye(3), -centre) for centre in centres]


POINTS = np.random.default_rng(0).uniform(-4, 4, (200, 3))


def test_references_in_the_units_of_the_run_pass() -> None:
    for factor, count in ((1.0, 8), (2.0, 4), (0.2, 3)):
        require_one_unit(walk(factor, count), walk(1.0), POINTS)
    require_one_unit(walk(1.0, 1), walk(1.0), POINTS[:0])


@pytest.mark.parametrize(
    ("factor", "cause"), [(1000.0, "times as far away"), (0.001, "times as close together")]
)
def test_metres_against_millimetres_are_an_error(factor: float, cause: str) -> None:
    with pytest.raises(InputError, match=cause) as error:
        require_one_unit(walk(factor), walk(1.0), POINTS)
    assert "millimetres" in str(error.value.hint)
