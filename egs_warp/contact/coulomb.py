"""Contact forces with exact Coulomb friction for a given Delassus operator (Eq. 8, 9)."""

from __future__ import annotations

import numpy as np
import scipy.linalg as dense


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
    blocks = delassus.reshape(count, 3, count, 3)[np.arange(count), :, np.arange(count), :]
    rate = 1.0 / np.einsum("nii->n", blocks) * 3.0
    force = start.copy()

    def residual(f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        velocity = (free_velocity + delassus @ f.ravel()).reshape(count, 3)
        velocity[:, 0] += shift
        return f - _project(f - rate[:, None] * velocity, f[:, 0], friction), velocity

    def size(value: np.ndarray) -> float:
        return float(np.abs(value / rate[:, None]).max(initial=0.0))

    best, best_size = force, np.inf
    for attempt in range(4):
        for _ in range(3 + 60 * attempt):
            force = _gauss_seidel_sweep(delassus, blocks, rate, free_velocity, shift, friction, force)
        value, velocity = residual(force)
        for _ in range(iteration_limit):
            current = size(value)
            if current < best_size:
                best, best_size = force, current
            if current < tolerance:
                break
            jacobian = _projection_jacobian(delassus, rate, force, velocity, friction)
            step = _newton_step(jacobian, -value.ravel()).reshape(count, 3)
            length = 1.0
            while length > 1e-3:
                trial = force + length * step
                trial_value, trial_velocity = residual(trial)
                if np.linalg.norm(trial_value / rate[:, None]) < (1.0 - 1e-4 * length) * np.linalg.norm(
                    value / rate[:, None]
                ):
                    break
                length *= 0.5
            else:
                break
            force, value, velocity = trial, trial_value, trial_velocity
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
    projected = force.copy()
    projected[:, 0] = np.maximum(force[:, 0], 0.0)
    radius = friction * np.maximum(normal, 0.0)
    length = np.linalg.norm(force[:, 1:], axis=1)
    projected[:, 1:] *= np.where(length > radius, radius / np.where(length > 0, length, 1.0), 1.0)[:, None]
    return projected


def _gauss_seidel_sweep(
    delassus: np.ndarray,
    blocks: np.ndarray,
    rate: np.ndarray,
    free_velocity: np.ndarray,
    shift: np.ndarray,
    friction: float,
    force: np.ndarray,
) -> np.ndarray:
    force = force.copy()
    for i in range(len(shift)):
        velocity = free_velocity[3 * i : 3 * i + 3] + delassus[3 * i : 3 * i + 3] @ force.ravel()
        normal = max(force[i, 0] - (velocity[0] + shift[i]) / blocks[i, 0, 0], 0.0)
        velocity = velocity + blocks[i, :, 0] * (normal - force[i, 0])
        tangent = force[i, 1:] - velocity[1:] / max(blocks[i, 1, 1], blocks[i, 2, 2])
        length = np.hypot(*tangent)
        if length > friction * normal:
            tangent = tangent * (friction * normal / length)
        force[i] = (normal, *tangent)
    return force


def _projection_jacobian(
    delassus: np.ndarray, rate: np.ndarray, force: np.ndarray, velocity: np.ndarray, friction: float
) -> np.ndarray:
    count = len(force)
    trial = force - rate[:, None] * velocity
    moved = np.eye(3 * count) - np.repeat(rate, 3)[:, None] * delassus
    jacobian = np.eye(3 * count)
    length = np.linalg.norm(trial[:, 1:], axis=1)
    radius = friction * np.maximum(force[:, 0], 0.0)
    for i in range(count):
        n, t = 3 * i, slice(3 * i + 1, 3 * i + 3)
        if trial[i, 0] > 0.0:
            jacobian[n] -= moved[n]
        if length[i] <= radius[i]:
            jacobian[t] -= moved[t]
        elif length[i] > 0.0:
            direction = trial[i, 1:] / length[i]
            slide = radius[i] / length[i] * (np.eye(2) - np.outer(direction, direction))
            jacobian[t] -= slide @ moved[t]
            if force[i, 0] > 0.0:
                jacobian[t, n] -= friction * direction
    return jacobian
