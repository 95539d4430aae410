"""Audit of a run: residuals of its equations, computed from the arrays of a trajectory alone. The audit shares no code
with the solver.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from egs_warp.locomotion.ledger import EnergyBalance, energy_balance
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.short_repr import short_repr


@dataclass(frozen=True)
class Audit:
    """Largest errors over all steps, as defined in docs/guide/report.md; all but the counts are dimensionless."""

    __repr__ = short_repr

    momentum_residual: float
    """Force that is missing from the balance of linear momentum, divided by m g."""
    angular_momentum_residual: float
    """Torque that is missing from the balance of angular momentum, divided by m g H."""
    energy_residual: float
    """Residual of the energy balance, divided by m g H."""
    cone_violation: float
    """Force outside the friction cone, divided by m g, at contacts with the ground and solids. ``world_audit`` covers
    contacts between bodies."""
    friction_gap: float
    """Difference between the actual work of friction and the work of a friction force at its bound that opposes the
    slip, divided by m g H, at contacts with the ground and solids."""
    contact_velocity: float
    """Difference between the stored end velocities of loaded contacts and their displacements per time step, divided by
    sqrt(g H)."""
    penetration: float
    """Depth of the deepest contact point, divided by H."""
    complementarity_gap: float
    """Normal force times gap at the end of the step, divided by m g H, at contacts with the ground and solids."""
    inverted_elements: int
    """Number of inverted elements, summed over all states."""
    newton_unconverged: int
    """Number of steps that did not converge."""
    end_stretch: float
    """Largest factor by which an element is stretched or compressed in any direction, between the first and the last
    state."""


def audit(trajectory: Trajectory, *, energy: EnergyBalance | None = None, newton_unconverged: int = 0) -> Audit:
    """Recompute every error from the trajectory.

    Args:
        trajectory: the run.
        energy: its energy balance; None computes it.
        newton_unconverged: number of steps that did not converge, which is copied to the result.
    """
    t = trajectory
    unit = t.node_mass.sum() * np.linalg.norm(t.gravity) * t.height
    linear, angular = momentum_residuals(t)
    normals = _contact_normals(t)
    normal = np.einsum("ci,ci->c", t.contact_force, normals)
    tangential = t.contact_force - normal[:, None] * normals
    friction_forces = np.linalg.norm(tangential, axis=1)
    by_velocities, displacements = contact_displacements(t)
    along = np.einsum("ci,ci->c", displacements, normals)
    slip = displacements - along[:, None] * normals
    # Coulomb: mu f_n |slip| + f_t . slip is never negative, and zero if friction is at its bound and opposes the slip,
    # or if the contact does not slip.
    fixed = t.contact_plane >= 0
    friction_gap = np.abs(t.friction * normal * np.linalg.norm(slip, axis=1) + np.einsum("ci,ci->c", tangential, slip))
    velocity_errors = np.linalg.norm(by_velocities - displacements, axis=1) / t.dt[t.contact_step]
    deepest = min(float(t.min_gap.min()), float(_uneven_end_gaps(t).min(initial=0.0)))
    edges = t.positions[:, t.tets[:, 1:]] - t.positions[:, t.tets[:, :1]]
    energy = energy or energy_balance(t)
    return Audit(
        momentum_residual=float(np.linalg.norm(linear, axis=1).max(initial=0.0) * t.height / unit),
        angular_momentum_residual=float(np.linalg.norm(angular, axis=1).max(initial=0.0) / unit),
        energy_residual=energy.max_residual,
        cone_violation=float(
            np.maximum(friction_forces - t.friction * normal, -normal)[fixed].max(initial=0.0) * t.height / unit
        ),
        friction_gap=float(friction_gap[fixed].max(initial=0.0) / unit),
        contact_velocity=float(
            velocity_errors[normal > 0.0].max(initial=0.0) / np.sqrt(np.linalg.norm(t.gravity) * t.height)
        ),
        penetration=float(max(-deepest, 0.0) / t.height),
        complementarity_gap=float((normal * np.maximum(_start_gaps(t) + along, 0.0))[fixed].max(initial=0.0) / unit),
        inverted_elements=int((np.linalg.det(edges) <= 0.0).sum()),
        newton_unconverged=newton_unconverged,
        end_stretch=end_stretch(t),
    )


def end_stretch(t: Trajectory) -> float:
    """Return the largest factor by which an element is stretched or compressed in any direction, between the first
    state, in which the body is at rest under its weight, and the last one. It is infinite if an element has collapsed
    or a position is not finite."""
    first, last = (x[t.tets[:, 1:]] - x[t.tets[:, :1]] for x in (t.positions[0], t.positions[-1]))
    if not (np.isfinite(first).all() and np.isfinite(last).all()):
        return float("inf")
    stretches = np.linalg.svd(np.linalg.solve(first, last), compute_uv=False)
    with np.errstate(divide="ignore"):
        return float(np.maximum(stretches[:, 0], 1.0 / stretches[:, -1]).max())


def momentum_residuals(t: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return the residuals of the momentum balances of F steps, (F, 3) N linear and (F, 3) N m angular: rate of change
    of the momentum minus external forces or torques."""
    mass = t.node_mass.sum()
    com = np.einsum("n,fni->fi", t.node_mass, t.positions) / mass
    momentum = np.einsum("n,fni->fi", t.node_mass, t.velocities)
    arms = t.positions - com[:, None]
    spin = np.einsum("n,fni->fi", t.node_mass, np.cross(arms, t.velocities))
    force, torque = np.zeros((len(t.dt), 3)), np.zeros((len(t.dt), 3))
    np.add.at(force, t.contact_step, t.contact_force)
    np.add.at(torque, t.contact_step, np.cross(start_points(t) - com[t.contact_step], t.contact_force))
    if len(t.joint_step):
        points = np.einsum("jw,jwi->ji", t.joint_weights, t.positions[t.joint_step[:, None], t.joint_nodes])
        np.add.at(force, t.joint_step, t.joint_force)
        np.add.at(torque, t.joint_step, np.cross(points - com[t.joint_step], t.joint_force))
    if len(t.kick_step):
        impulses = t.node_mass[:, None] * t.kick_velocity / t.dt[t.kick_step, None, None]
        np.add.at(force, t.kick_step, impulses.sum(axis=1))
        np.add.at(torque, t.kick_step, np.cross(arms[t.kick_step], impulses).sum(axis=1))
    dt = t.dt[:, None]
    moved = np.diff(t.positions, axis=0) / dt[:, None]
    drag_force = t.drag * np.einsum("n,fni->fi", t.node_mass, moved)
    drag_torque = t.drag * np.einsum("n,fni->fi", t.node_mass, np.cross(arms[:-1], moved))
    linear = np.diff(momentum, axis=0) / dt - mass * t.gravity - force + drag_force
    return linear, np.diff(spin, axis=0) / dt - torque + drag_torque


def start_points(t: Trajectory) -> np.ndarray:
    """Return (C, 3) m, positions of the contacts at the start of their steps."""
    return np.einsum("cw,cwi->ci", t.contact_weights, t.positions[t.contact_step[:, None], t.contact_nodes])


def _start_gaps(t: Trajectory) -> np.ndarray:
    """Return (C,) m, distance of each contact from its plane, or from the tangent plane of uneven ground, at the start
    of the contact's step. The values of contacts with other bodies are meaningless."""
    planes = t.planes[np.maximum(t.contact_plane, 0)]
    points = start_points(t)
    gaps = np.einsum("ci,ci->c", planes[:, :3], points) + planes[:, 3]
    uneven = _on_uneven_ground(t)
    gaps[uneven] = _ground_gaps(t, points[uneven])
    return gaps


def _on_uneven_ground(t: Trajectory) -> np.ndarray:
    """Return (C,) bool, True for contacts with uneven ground."""
    return (t.contact_plane == 0) & (t.ground_coefficients.size > 0)


def _contact_normals(t: Trajectory) -> np.ndarray:
    """Return (C, 3) unit normals of the contacts: recomputed from the heights on uneven ground, else as stored."""
    normals, uneven = t.contact_normal.copy(), _on_uneven_ground(t)
    normals[uneven] = _ground(t, start_points(t)[uneven])[1]
    return normals


def _uneven_end_gaps(t: Trajectory) -> np.ndarray:
    """Return (c,) m, the gaps of the c contacts with uneven ground at the ends of their steps."""
    after = t.contact_step + 1
    ends = np.einsum("cw,cwi->ci", t.contact_weights, t.positions[after[:, None], t.contact_nodes])
    return _ground_gaps(t, ends[_on_uneven_ground(t)])


def _ground_gaps(t: Trajectory, points: np.ndarray) -> np.ndarray:
    """Return (n,) m, distance of each of the ``points`` (n, 3) from the tangent plane of the ground below it."""
    lift, normals = _ground(t, points)
    return ((points - t.ground_origin) @ t.ground_axes[2] - lift) * (normals @ t.ground_axes[2])


def _ground(t: Trajectory, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (n,) m, height of uneven ground at ``points`` (n, 3), and (n, 3) its normals, computed with SciPy's
    splines and finite differences."""
    if len(points) == 0:
        return np.zeros(0), np.zeros((0, 3))
    # The ground continues level beyond its edge.
    padded = np.pad(t.ground_coefficients, 3, mode="edge")
    flat = (points - t.ground_origin) @ t.ground_axes[:2].T / t.ground_spacing + 3.0

    def height(across: float, along: float) -> np.ndarray:
        at = np.stack([flat[:, 1] + along, flat[:, 0] + across])
        return np.asarray(ndimage.map_coordinates(padded, at, order=2, mode="nearest", prefilter=False))

    small = 1e-4
    first = (height(small, 0.0) - height(-small, 0.0)) / (2.0 * small * t.ground_spacing)
    second = (height(0.0, small) - height(0.0, -small)) / (2.0 * small * t.ground_spacing)
    normals = np.stack([-first, -second, np.ones(len(points))], axis=1) @ t.ground_axes
    return height(0.0, 0.0), normals / np.linalg.norm(normals, axis=1)[:, None]


def contact_displacements(t: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return two displacements of each contact in its step, each (C, 3) m: computed from the stored end velocities, and
    from the positions."""
    after = t.contact_step + 1
    velocities = np.einsum("cw,cwi->ci", t.contact_weights, t.velocities[after[:, None], t.contact_nodes])
    ends = np.einsum("cw,cwi->ci", t.contact_weights, t.positions[after[:, None], t.contact_nodes])
    return t.dt[t.contact_step, None] * velocities, ends - start_points(t)
