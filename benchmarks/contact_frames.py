"""Input of the solver benchmarks: the steps of an animation with known activations, each as a QP with Coulomb
contact."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.cluster.vq import kmeans2

from egs_warp.assets import pawn, stool
from egs_warp.contact.detection import contact_geometry
from egs_warp.fem.body import BodyState, make_body
from egs_warp.fem.step_problem import StepProblem
from egs_warp.io import read_capture
from egs_warp.locomotion.contact_modes import CoulombProgram, PredictedContact
from egs_warp.locomotion.linear_step import StepLinearizer
from egs_warp.locomotion.objectives import AngularMomentumObjective, centre_of_mass_velocity, node_velocities
from egs_warp.locomotion.rollout import FRAME_RATE
from egs_warp.locomotion.settling import settle
from egs_warp.locomotion.stepper import LocomotionStepper, WarmStart
from egs_warp.locomotion.synergies import Synergies
from egs_warp.meshing.cage import build_cage
from egs_warp.motions.balance import Weights
from egs_warp.muscles.muscle_set import MuscleSet, automatic_muscles
from egs_warp.muscles.tension import MuscleEnergy
from egs_warp.segmentation.base_plane import find_base_plane
from harness import data_folder

CAPTURES = {"monkey": ("monkey.ply", (0.0, 1.0, 0.0)), "plush dog": ("plush_dog.ply", (0.0, -1.0, 0.0))}
"""File in the data folder and up direction of each real capture."""


@dataclass(frozen=True)
class Frame:
    """One step of the animation, the input of every strategy."""

    program: CoulombProgram
    predicted: PredictedContact
    """Contact state predicted from the known activations of the previous step."""
    known: np.ndarray
    """(M,) known activations of this step, within their bounds."""


@dataclass(frozen=True)
class BenchBody:
    """A body with muscles on the ground, ready to be stepped."""

    stepper: LocomotionStepper
    start: BodyState
    device: str


def body_named(name: str, device: str, *, nodes: int = 300) -> BenchBody:
    """Build a body 1 m tall with a cage of about ``nodes`` nodes.

    Args:
        name: a built-in body ("pawn", "stool") or a real capture of ``CAPTURES``.
    """
    if name in CAPTURES:
        file, up = CAPTURES[name]
        cloud = read_capture(data_folder() / "objects" / file, device=device).cloud
        plane = find_base_plane(cloud, np.array(up))
    else:
        scene = {"pawn": pawn, "stool": stool}[name](device=device)
        cloud, plane = scene.cloud, scene.plane
    cage = build_cage(cloud, plane, target_nodes=nodes)
    scale = 1.0 / cage.height(plane)
    cloud, plane, cage = cloud.scaled(scale), plane.scaled(scale), cage.scaled(scale)
    body = make_body(cage.mesh, plane, sag=0.02, device=device)
    muscles = automatic_muscles(
        cage.mesh,
        plane.normal,
        body_weight=body.weight,
        height=body.height,
        strength=body.stiffening,
        young_modulus=body.young_modulus,
    )
    geometry = contact_geometry(cloud, cage.mesh, (plane,), device=device)
    stepper = LocomotionStepper(body, muscles, geometry, device=device)
    return BenchBody(stepper, settle(stepper), device)


def grouped_segments(muscles: MuscleSet, nodes: np.ndarray, groups: int, seed: int) -> Synergies:
    """Group neighbouring muscle segments of similar direction; the segments of a group share one activation.

    Args:
        muscles: muscles with their segments.
        nodes: (N, 3) m, rest positions.
        groups: number of groups.
        seed: seed of the clustering.
    """
    ends = muscles.end_points(nodes)
    first, second = ends[muscles.segments[:, 0]], ends[muscles.segments[:, 1]]
    upright = np.abs(second - first)[:, 2] / np.linalg.norm(second - first, axis=1)
    features = np.column_stack([0.5 * (first + second), 0.5 * upright * np.ptp(nodes, axis=0).max()])
    # SciPy 1.15 renamed the argument ``seed``; with the new name, the random numbers are different.
    _, group = kmeans2(features, groups, minit="++", seed=seed)  # pyright: ignore[reportCallIssue]
    return Synergies(group.astype(np.int32))


def spread_points(bench: BenchBody, count: int) -> np.ndarray:
    """Return (count,) indices of points on the ground at rest that are far apart (farthest-point sampling)."""
    gaps, _ = bench.stepper.detector.gaps(bench.start.positions)
    near = np.flatnonzero(gaps < 0.01 * bench.stepper.body.height)
    nodes = bench.stepper.geometry.mesh.tets[bench.stepper.geometry.tet_from_point[near]]
    places = np.einsum("kw,kwi->ki", bench.stepper.geometry.weights[near], bench.start.positions[nodes])
    chosen = [int(np.argmax(np.linalg.norm(places - places.mean(axis=0), axis=1)))]
    while len(chosen) < count:
        distances = np.linalg.norm(places[:, None] - places[chosen], axis=2).min(axis=1)
        chosen.append(int(np.argmax(distances)))
    return near[chosen]


def known_activations(count: int, frames: int, strength: float, seed: int) -> np.ndarray:
    """Return (frames + 1, count) smooth signals in [-strength, strength] that start at 0."""
    random = np.random.default_rng(seed)
    time = np.arange(frames + 1)[:, None, None]
    periods = random.uniform(5.0, 25.0, (1, count, 3))
    waves = np.sin(2.0 * np.pi * (time / periods + random.random((1, count, 3))))
    ramp = np.minimum(np.arange(frames + 1) / 5.0, 1.0)[:, None]
    return strength * ramp * waves.mean(axis=2) / np.abs(waves.mean(axis=2)).max()


def animation_frames(
    bench: BenchBody,
    *,
    frames: int = 50,
    activations: int = 10,
    contacts: int = 5,
    strength: float = 0.3,
    seed: int = 0,
) -> list[Frame]:
    """Simulate an animation with known activations of muscle groups and exact contact at a few points.

    The targets of a step's objectives are the animation's own values at the end of the step: the velocity of the centre
    of mass, the angular momentum and the node velocities. The engine's planner builds the program of each step.

    Raises:
        RuntimeError: a step did not converge.
    """
    body, muscles = bench.stepper.body, bench.stepper.muscles
    stepper = LocomotionStepper(body, muscles, bench.stepper.geometry, device=bench.device)
    synergies = grouped_segments(muscles, body.mesh.nodes, activations, seed)
    steps = StepLinearizer(muscles, synergies)
    stepper.planner = replace(stepper.planner, synergies=synergies, linear_steps=steps)
    # Only the chosen points are in contact, even if others penetrate the ground.
    stepper.solver = replace(stepper.solver, penetration_tolerance=np.inf)
    points = spread_points(bench, contacts)
    known = known_activations(activations, frames, strength, seed)
    weights, dt = Weights(), 1.0 / FRAME_RATE
    state, forces = bench.start, np.zeros((contacts, 3))
    animation = []
    for previous, current in zip(known[:-1], known[1:], strict=True):
        before, now = (muscles.bounds * (synergies.members @ a) for a in (previous, current))
        problem = StepProblem(body, state, dt)
        contact_set = stepper.detector.contact_set(points, state.positions)
        memory = WarmStart(points, forces, before)
        prospect = stepper.predict(stepper.step_inputs(problem, contact_set, memory))
        result = stepper.solver.solve(
            prospect.linearization,
            MuscleEnergy.of(muscles, now),
            velocities=prospect.velocities,
            forces=prospect.forces,
        )
        if not result.converged:
            raise RuntimeError(f"the animation did not converge at frame {len(animation)}; use a smaller strength")
        after = BodyState(problem.end_positions(result.velocities), result.velocities, state.time + dt)
        objectives = [
            centre_of_mass_velocity(body, body.centre_of_mass(after.velocities), weights.com),
            AngularMomentumObjective(body.angular_momentum(after.positions, after.velocities), weights.spin),
            node_velocities(body, after.velocities, weights.pose),
        ]
        program = stepper.planner.program(prospect, before, objectives)
        animation.append(Frame(program.program, program.predicted, current))
        state, forces = after, result.forces
    return animation
