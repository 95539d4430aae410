"""Phases, planned quantities and weights of a walk."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class WalkPhase(Enum):
    """Phases of a walk; swing and stand alternate."""

    SHIFT = "shift"
    """The body shifts its weight, so that it can lift its first feet."""
    SWING = "swing"
    STAND = "stand"
    GATHER = "gather"
    """The body returns to its standing pose."""
    REST = "rest"


@dataclass(frozen=True)
class WalkPlan:
    """Planned quantities of a walk, in metres and seconds."""

    paces: float
    pace_length: float
    """Length of the longest step, m."""
    swing_time: float
    double_time: float
    lift: float
    stride: float
    """Maximum distance between two consecutive footprints of one foot, m."""


@dataclass(frozen=True)
class WalkControl:
    """Weights of the objectives, with speeds in units of sqrt(g H), and feedback gains.

    With ten times the weights, the muscles do three times as much work, because they act against each other. With a
    tenth of the weights, a box falls.
    """

    com: float = 300.0
    """Weight of the velocity of the centre of mass, for balance. With a fifth of this weight, the centre of pressure of
    a robot on two feet is on average 0.01 to 0.04 body heights ahead of the requested one, and the robot falls
    backward. Where friction does not suffice for balance and turning, balance has priority."""
    spin: float = 60.0
    pose: float = 0.1
    unload: float = 10.0
    """Weight of the load on the contact points of a lifted foot."""
    slip: float = 100.0
    """Weight of the sliding velocity of a standing foot at its centre of pressure."""
    balance: float = 3.0
    """Displacement of the centre of pressure, in metres, per metre of error of the divergent component of motion."""
    turn_rate: float = 4.0
    """Rate in sqrt(g / H) at which tilt is corrected."""
    follow: float = 12.0
    """Rate in sqrt(g / H) at which the pose is approached."""
    foot_share: float = 0.3
    """Fraction of a swinging foot's position error that is removed in one time step."""
    margin: float = 0.8
    """Fraction of each sole over which the centre of pressure may move."""
    planned_margin: float = 0.6
    """Fraction of each sole over which the plan places the centre of pressure."""
    sidestep: float = 5.5
    """Rate in sqrt(g / H) at which the target of a swinging foot moves to the position that catches the body."""
