"""Which random numbers a draw takes: those of one purpose never depend on how many another draws."""

from __future__ import annotations

from enum import IntEnum


class Stream(IntEnum):
    """Purposes of random numbers, after the seed. Results depend on the values: they stay."""

    REAL_VIEWS = 0
    PSEUDO_VIEWS = 1
    REFINEMENT = 2
    POSITION_NOISE = 3
    RIVR = 5
    CONSOLIDATION = 6
    ADDED_POINTS = 100
    LEFT_OUT_POINTS = 101
    UNSEEN_PIXELS = 102

    # Of synthetic captures.
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
