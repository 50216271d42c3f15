"""Lenses of synthetic captures: a zoom, a switch of lenses, focus breathing and a fisheye."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cleargs.errors import InputError
from cleargs.synth.optics import BREATHING, FISHEYE_VIEW, ZOOM, lens_at, phone_lens
from cleargs.synth.path import look_at
from cleargs.synth.raycast import room_setup
from cleargs.synth.synthetic_capture import make_capture


def test_focal_lengths_follow_the_kind_of_the_lens() -> None:
    first = phone_lens(320, 240)
    shares = np.linspace(0, 1, 25)
    factors = {
        kind: np.array([lens_at(kind, first, share).fx / first.fx for share in shares])
        for kind in ("phone", "zoom", "switch", "breathing")
    }
    assert (factors["phone"] == 1).all()
    np.testing.assert_allclose(factors["zoom"], ZOOM**shares)
    assert set(factors["switch"]) == {1.0, ZOOM} and (factors["switch"] == 1).sum() == 13
    np.testing.assert_allclose(np.ptp(factors["breathing"]), 2 * BREATHING, rtol=0.02)


def test_a_fisheye_sees_each_angle_at_its_distance_from_the_centre() -> None:
    setup = room_setup(4, 64, 48, 1)
    fisheye = lens_at("fisheye", setup.lens, 0.0)
    assert fisheye.width / fisheye.fx == pytest.approx(FISHEYE_VIEW)
    pose = look_at(np.array([0.4, 1.4, 0.3]), np.zeros(3))
    seen = setup.world.depth(pose, fisheye)
    # A pinhole of 120 degrees with the same axis sees the same surfaces at the tangents of the angles.
    width = 1200
    flat = replace(setup.lens, width=width, height=width, cx=width / 2, cy=width / 2, fx=340.0, fy=340.0)
    depth = setup.world.depth(pose, flat)
    agree = []
    for row in range(4, 44, 4):
        for column in range(12, 52, 4):
            x, y = (column + 0.5 - fisheye.cx) / fisheye.fx, (row + 0.5 - fisheye.cy) / fisheye.fy
            angle = math.hypot(x, y)
            scale = 340.0 * math.tan(angle) / angle
            there = depth[int(width / 2 + scale * y), int(width / 2 + scale * x)]
            agree.append(abs(seen[row, column] / there - 1))
    assert np.quantile(agree, 0.9) < 0.02  # the rest is at the edges of things


def test_a_zoom_is_in_the_listing_of_the_frames(tmp_path: Path) -> None:
    make_capture(tmp_path / "room", "sharp", frames=3, width=48, height=32, lens="zoom")
    listed = json.loads((tmp_path / "room/transforms.json").read_text())
    focal = [frame["fl_x"] for frame in listed["frames"]]
    np.testing.assert_allclose(focal, listed["fl_x"] * np.array([1.0, ZOOM**0.5, ZOOM]))
    with pytest.raises(InputError, match="no lens is called 'macro'"):
        make_capture(tmp_path / "other", "sharp", frames=3, width=48, height=32, lens="macro")
