"""Phases, numbers and weights of a walk."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class WalkPhase(Enum):
    """Phases of a walk; swing and stand alternate."""

    SHIFT = "shift"
    """The body leans to where it can lift its first feet."""
    SWING = "swing"
    STAND = "stand"
    GATHER = "gather"
    """Back to the pose it stood in."""
    REST = "rest"


@dataclass(frozen=True)
class WalkPlan:
    """Numbers of a walk; metres, seconds."""

    paces: float
    pace_length: float
    """The longest."""
    swing_time: float
    double_time: float
    lift: float
    stride: float
    """Longest way between two footprints of one foot."""


@dataclass(frozen=True)
class WalkControl:
    """Weights of the objectives (speeds are compared in sqrt(g H)) and gains of the feedback. With ten times the
    weights muscles work three times as much, against each other; with a tenth of them a box falls."""

    spin: float = 60.0
    pose: float = 0.1
    unload: float = 10.0
    """Of what contact points of a foot carry that is lifted."""
    balance: float = 3.0
    """How far the centre of pressure goes for each metre that the divergent part of the motion is off."""
    turn_rate: float = 4.0
    """Of the body's tilt, in sqrt(g / H)."""
    follow: float = 12.0
    """Of the pose, in sqrt(g / H)."""
    foot_share: float = 0.3
    """Of a swinging foot's error that is removed in one step."""
    margin: float = 0.8
    """Part of each sole over which the centre of pressure may move."""
    planned_margin: float = 0.6
    """Part of each sole over which it is planned to be."""
    sidestep: float = 5.5
    """Rate, in sqrt(g / H), at which a swinging foot's goal goes to where it would catch the body."""
