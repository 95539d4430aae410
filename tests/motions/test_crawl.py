"""Crawling of a long body by a wave: strain limit, unloaded sections, and targets ahead and to the side."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest

from egs_warp.fem.body import DEFAULT_SAG
from egs_warp.locomotion.audit import audit
from egs_warp.locomotion.objectives import LoadObjective
from egs_warp.locomotion.recorder import Recorder
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory, measure
from egs_warp.motions.crawl import MAX_STRAIN, Crawl
from egs_warp.motions.feet import SupportKind
from egs_warp.motions.gait_selection import move_along, turn_in_place
from egs_warp.motions.route import Route, path_route, straight_route
from tests.support.creatures import CoarseCreature, coarse_creature
from tests.support.meshes import worm_mesh
from tests.support.stances import DT, FORWARD


@cache
def worm() -> CoarseCreature:
    return coarse_creature(worm_mesh(), forward=FORWARD, sag=DEFAULT_SAG)


@dataclass(frozen=True)
class Crawled:
    """Result of a crawl."""

    crawl: Crawl
    trajectory: Trajectory
    reports: list[StepReport]
    place: np.ndarray
    """(3,) planar pose at the end: position (m) and heading (rad)."""


def crawled(route: Route) -> Crawled:
    """Simulate a crawl until the body rests."""
    made = worm()
    crawl = Crawl(made.place, route)
    state, memory, reports = made.start, made.stepper.initial_memory(), []
    for _ in range(300):
        wishes = crawl.objectives(state, reports[-1] if reports else None, DT)
        state, memory, fresh = made.stepper.advance(state, memory, wishes, DT)
        reports += fresh
        if crawl.is_at_rest:
            break
    assert crawl.is_at_rest and crawl.notes() == []
    recorder = Recorder(made.stepper.body, made.stepper.muscles, made.stepper.geometry, made.start, 0.0, drag=0.0)
    recorder.add(reports)
    place = crawl._planar_pose(made.place.ground.local(state.positions))
    return Crawled(crawl, recorder.trajectory(), reports, place)


def test_a_body_along_the_ground_crawls() -> None:
    place = worm().place
    assert place.base() is SupportKind.LYING
    assert isinstance(move_along(place, straight_route(1.0), 0.1), Crawl) and isinstance(
        turn_in_place(place, 1.0, 0.1), Crawl
    )


def test_a_stride_strains_the_body_within_its_limit() -> None:
    """The maximum strain, at the steepest point of the wave, is close to the limit; every section ends at the
    target."""
    crawl = Crawl(worm().place, straight_route(5.0))
    crawl._to = np.array([crawl.step_limits.length, 0.0, 0.0])
    along_it, most = crawl._standing[:, 0], 0.0
    for elapsed in np.linspace(0.0, crawl._round, 60):
        pose = crawl._pose(float(elapsed))
        order = np.argsort(along_it)
        moved, rest = (pose - crawl._standing)[order, 0], along_it[order]
        apart = np.diff(rest) > 0.1
        most = max(most, float(np.abs(np.diff(moved)[apart] / np.diff(rest)[apart]).max()))
    assert 0.7 * MAX_STRAIN < most < 1.01 * MAX_STRAIN
    assert crawl._pose(crawl._round) == pytest.approx(crawl._posed_nodes(crawl._to))
    assert crawl._pose(0.0) == pytest.approx(crawl._standing)


def test_lifted_sections_are_unloaded_from_the_front() -> None:
    """At 0.2 of a cycle, the front of the body is unloaded; at 0.8, the back."""
    made = worm()
    crawl = Crawl(made.place, straight_route(1.0))
    crawl.objectives(made.start, None, DT)
    middles = []
    for part in (0.2, 0.8):
        time = part * crawl._round
        wishes = crawl.objectives(type(made.start)(made.start.positions, made.start.velocities, time), None, DT)
        (load,) = [wish for wish in wishes if isinstance(wish, LoadObjective)]
        middles.append(float(made.start.positions[load.nodes, 0].mean()))
    assert middles[0] > 1.0 and middles[1] < -1.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("route", "goal"),
    [(straight_route(0.5), [0.5, 0.0]), (path_route(np.array([[0.2, 0.2]])), [0.2, 0.2])],
    ids=["ahead", "aside"],
)
def test_a_worm_reaches_its_target(route: Route, goal: list[float]) -> None:
    done = crawled(route)
    assert done.place[:2] == pytest.approx(goal, abs=0.07)
    assert abs(np.degrees(done.place[2])) < 3.0 and measure(done.trajectory).tilt_degrees < 5.0
    found = audit(done.trajectory, newton_unconverged=sum(not report.converged for report in done.reports))
    assert found.momentum_residual < 1e-5 and found.angular_momentum_residual < 1e-4 and found.penetration < 0.01
    assert found.cone_violation < 1e-4 and found.complementarity_gap < 1e-4 and found.inverted_elements == 0
    assert found.energy_residual < 1e-6 and found.contact_velocity < 1e-6
