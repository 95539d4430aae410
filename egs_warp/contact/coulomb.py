"""Contact forces with exact Coulomb friction for a given Delassus operator (Eq. 8, 9)."""

from __future__ import annotations

import numpy as np
import scipy.linalg as dense
import warp as wp

from egs_warp.kernels.contact.coulomb import gauss_seidel_kernel

_LENGTHS = 0.5 ** np.arange(10.0)[:, None, None]
"""Shares of a Newton step that are tried."""


def coulomb_forces(
    delassus: np.ndarray,
    free_velocity: np.ndarray,
    shift: np.ndarray,
    friction: float,
    start: np.ndarray,
    *,
    tolerance: float = 1e-12,
    iteration_limit: int = 60,
) -> tuple[np.ndarray, float]:
    """Forces f (n, 3) with 0 <= f_n, 0 <= u_n + shift, complementary, and exact Coulomb friction; u = free + G f
    (Eq. 8, 9).

    ``delassus`` G (3n, 3n) m/(N s); ``free_velocity`` (3n,) m/s; ``shift`` (n,) m/s; ``start`` (n, 3). Semismooth
    Newton on the projection equations of Alart and Curnier, started from block Gauss-Seidel. Returns the residual (m/s)
    too.
    """
    count = len(shift)
    if count == 0:
        return start, 0.0
    rate = 3.0 / delassus.diagonal().reshape(count, 3).sum(axis=1)[:, None]
    force = start.copy()

    def velocity_of(f: np.ndarray) -> np.ndarray:
        velocity = (free_velocity + delassus @ f.ravel()).reshape(count, 3)
        velocity[:, 0] += shift
        return velocity

    def residual(f: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        return f - _project(f - rate * velocity, f[..., 0], friction)

    best, best_size = force, np.inf
    for attempt in range(4):
        force = _swept(delassus, free_velocity, shift, friction, force, sweeps=3 + 60 * attempt)
        velocity = velocity_of(force)
        value = residual(force, velocity)
        for _ in range(iteration_limit):
            current = float(np.abs(value / rate).max())
            if current < best_size:
                best, best_size = force, current
            if current < tolerance:
                break
            jacobian = _projection_jacobian(delassus, rate, force, velocity, friction)
            step = _newton_step(jacobian, -value.ravel()).reshape(count, 3)
            change = (delassus @ step.ravel()).reshape(count, 3)
            # All lengths at once where the whole step will not do.
            for lengths in (_LENGTHS[:1], _LENGTHS[1:]):
                trials = force + lengths * step
                velocities = velocity + lengths * change
                values = residual(trials, velocities)
                sizes = np.linalg.norm((values / rate).reshape(len(lengths), -1), axis=1)
                enough = sizes < (1.0 - 1e-4 * lengths.ravel()) * np.linalg.norm(value / rate)
                if enough.any():
                    break
            else:
                break
            longest = int(np.argmax(enough))
            force, value, velocity = trials[longest], values[longest], velocities[longest]
        if best_size < tolerance:
            break
        force = best
    normal = np.maximum(best[:, 0], 0.0)
    return _project(np.column_stack([normal, best[:, 1:]]), normal, friction), best_size


def _newton_step(jacobian: np.ndarray, right: np.ndarray) -> np.ndarray:
    factor, solve = dense.get_lapack_funcs(("getrf", "getrs"), (jacobian,))
    factors, pivots, _ = factor(jacobian)
    diagonal = np.abs(np.diag(factors))
    if diagonal.min() > 1e-11 * diagonal.max():
        return solve(factors, pivots, right)[0]
    if not np.isfinite(diagonal).all():
        return np.zeros_like(right)
    # Redundant contacts: of all steps that do equally well, the shortest keeps the forces bounded.
    return np.linalg.lstsq(jacobian, right, rcond=1e-11)[0]


def _project(force: np.ndarray, normal: np.ndarray, friction: float) -> np.ndarray:
    """Forces (..., 3) with the normal part at least 0 and the tangential part at most ``friction`` x ``normal``."""
    projected = force.copy()
    projected[..., 0] = np.maximum(force[..., 0], 0.0)
    radius = friction * np.maximum(normal, 0.0)
    length = np.hypot(force[..., 1], force[..., 2])
    projected[..., 1:] *= np.where(length > radius, radius / np.where(length > 0, length, 1.0), 1.0)[..., None]
    return projected


def _swept(
    delassus: np.ndarray,
    free_velocity: np.ndarray,
    shift: np.ndarray,
    friction: float,
    force: np.ndarray,
    *,
    sweeps: int,
) -> np.ndarray:
    """(n, 3) forces after Gauss-Seidel sweeps that start from ``force``."""
    swept = np.ascontiguousarray(force, dtype=np.float64).copy()
    arrays = [
        wp.array(np.ascontiguousarray(value), device="cpu", copy=False) for value in (delassus, free_velocity, shift)
    ]
    out = wp.array(swept.reshape(-1), device="cpu", copy=False)
    wp.launch(gauss_seidel_kernel, dim=1, inputs=[*arrays, friction, sweeps, out], device="cpu")
    return out.numpy().reshape(swept.shape).copy()


def _projection_jacobian(
    delassus: np.ndarray, rate: np.ndarray, force: np.ndarray, velocity: np.ndarray, friction: float
) -> np.ndarray:
    """Derivative (3n, 3n) of ``force`` - its projection, row by row as each contact separates, sticks or slides."""
    count = len(force)
    trial = force - rate * velocity
    moved = np.eye(3 * count) - np.repeat(rate, 3)[:, None] * delassus
    moved = moved.reshape(count, 3, 3 * count)
    length = np.linalg.norm(trial[:, 1:], axis=1)
    radius = friction * np.maximum(force[:, 0], 0.0)
    sliding = length > radius
    safe = np.where(length > 0.0, length, 1.0)
    direction = trial[:, 1:] / safe[:, None]
    slide = (radius / safe)[:, None, None] * (np.eye(2) - direction[:, :, None] * direction[:, None, :])
    taken = np.empty_like(moved)
    taken[:, 0] = np.where((trial[:, 0] > 0.0)[:, None], moved[:, 0], 0.0)
    taken[:, 1:] = np.where(sliding[:, None, None], slide @ moved[:, 1:], moved[:, 1:])
    jacobian = np.eye(3 * count) - taken.reshape(3 * count, 3 * count)
    pressed = np.flatnonzero(sliding & (force[:, 0] > 0.0))
    for t in (0, 1):
        jacobian[3 * pressed + 1 + t, 3 * pressed] -= friction * direction[pressed, t]
    return jacobian
