"""Audit of the joints of a world, from the trajectories of its bodies alone (docs/concepts/bodies.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from egs_warp.fem.joints import PointJoint
from egs_warp.locomotion.trajectory import Trajectory


@dataclass(frozen=True)
class JointAudit:
    """Largest errors of a joint over all steps. m g is the weight of the lighter body, and H the height of the shorter
    one."""

    joint: int
    """Index of the joint in the world."""
    bodies: tuple[int, ...]
    """Indices of its one or two bodies in the world."""
    gap: float
    """Distance between the points of the joint, or between its point and its place, divided by H."""
    unmatched_forces: int
    """Number of recorded forces without a force on the other body in the same step; 0 for a joint of one body."""
    force_residual: float
    """Sum of the forces on both bodies in a step, divided by m g; 0 for a joint of one body."""
    torque_residual: float
    """Sum of the torques on both bodies about the origin in a step, divided by m g H; 0 for a joint of one body."""
    work_residual: float
    """Work of the joint on all its bodies in a step, divided by m g H."""
    largest_force: float
    """Largest force, divided by m g; it has no limit."""


def audit_joint(joint: PointJoint, number: int, trajectories: Sequence[Trajectory]) -> JointAudit:
    """Compute the errors of a joint.

    Args:
        joint: the joint.
        number: its index in the world.
        trajectories: trajectory of each body of the world. The bodies of a joint are always stepped together, so their
            steps are the same.
    """
    own = [trajectories[body] for body in joint.bodies]
    weight = min(float(t.node_mass.sum() * np.linalg.norm(t.gravity)) for t in own)
    height = min(t.height for t in own)
    paths = [
        np.einsum("w,fwi->fi", point.weights, t.positions[:, point.nodes])
        for t, point in zip(own, joint.points, strict=True)
    ]
    count = min(map(len, paths))
    gaps = paths[0][:count] - (paths[1][:count] if len(paths) > 1 else joint.place)
    records = [np.flatnonzero(t.joint_index == number) for t in own]
    steps = [t.joint_step[chosen] for t, chosen in zip(own, records, strict=True)]
    common = np.intersect1d(steps[0], steps[-1])
    forces, torques, work = np.zeros((len(common), 3)), np.zeros((len(common), 3)), np.zeros(len(common))
    largest = 0.0
    for t, chosen, at in zip(own, records, steps, strict=True):
        chosen = chosen[np.isin(at, common)]
        force, nodes, weights = t.joint_force[chosen], t.joint_nodes[chosen], t.joint_weights[chosen]
        start, end = (
            np.einsum("jw,jwi->ji", weights, t.positions[(common + after)[:, None], nodes]) for after in (0, 1)
        )
        forces += force
        torques += np.cross(start, force)
        work += np.einsum("ji,ji->j", force, end - start)
        largest = max(largest, float(np.linalg.norm(force, axis=1).max(initial=0.0)))
    sums = [float(np.linalg.norm(each, axis=1).max(initial=0.0)) for each in (forces, torques)]
    is_pair = len(own) > 1
    return JointAudit(
        joint=number,
        bodies=joint.bodies,
        gap=float(np.linalg.norm(gaps, axis=1).max()) / height,
        unmatched_forces=sum(map(len, steps)) - len(own) * len(common),
        force_residual=sums[0] / weight if is_pair else 0.0,
        torque_residual=sums[1] / (weight * height) if is_pair else 0.0,
        work_residual=float(np.abs(work).max(initial=0.0)) / (weight * height),
        largest_force=largest / weight,
    )
