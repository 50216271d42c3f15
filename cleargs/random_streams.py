"""Separate streams of random numbers, so that the numbers of one purpose do not depend on other draws."""

from __future__ import annotations

from enum import IntEnum


class Stream(IntEnum):
    """Purposes of random numbers. The value is a part of the seed, so a changed value changes results."""

    REAL_VIEWS = 0
    PSEUDO_VIEWS = 1
    REFINEMENT = 2
    POSITION_NOISE = 3
    BACKGROUND = 4
    RIVR = 5
    CONSOLIDATION = 6
    TEXTURE = 7
    ADDED_POINTS = 100
    LEFT_OUT_POINTS = 101
    UNSEEN_PIXELS = 102
    MATCHED_POINTS = 103

    # For synthetic captures.
    ROOM = 11
    HAND = 12
    MIXED_FAULTS = 13
    NOVEL_POSES = 14
    EXPOSURES = 15
    WALK = 16
    ORBIT = 17
    POSE_NOISE = 18
    SHAKY_STRETCHES = 19
    BALLOON = 20
    PHONE_LOOK = 21
    HOUSEHOLD = 30
