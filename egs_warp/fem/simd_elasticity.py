"""Elasticity on a CPU, four elements at a time; launches the kernels of ``egs_warp.kernels.fem.elasticity_cpu``."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from egs_warp.fem.assembly_topology import AssemblyTopology, Damping, Material
from egs_warp.kernels.fem import elasticity_cpu as kernels
from egs_warp.kernels.fem.elasticity import DIAGONAL_TOLERANCE, MAX_SWEEPS
from egs_warp.launching import empty, launch_cached
from egs_warp.muscles.tension import LENGTH_FULL_FORCE, LENGTH_ZERO_FORCE, MuscleEnergy
from egs_warp.precision import real


class SimdElasticity:
    """Elasticity of one mesh on the CPU: arrays in groups of four elements, and scratch memory."""

    def __init__(self, maps: AssemblyTopology, material: Material, device: wp.Device) -> None:
        self._device, self._tet_count = device, len(maps.tets)
        more = -self._tet_count % kernels.LANES
        # Copies of the last element with zero volume fill the last group.
        padded = np.r_[np.arange(self._tet_count), np.full(more, self._tet_count - 1)]
        groups = len(padded) // kernels.LANES
        rests = maps.rest_inverses[padded].reshape(groups, kernels.LANES, 9).transpose(0, 2, 1)
        elements = kernels.Elements()
        elements.corners = wp.array(maps.tets[padded].ravel(), dtype=int, device=device)
        elements.rests = wp.array(np.ascontiguousarray(rests).ravel(), dtype=real, device=device)
        elements.volumes = wp.array(np.r_[maps.volumes, np.zeros(more)], dtype=real, device=device)
        elements.entries = wp.array(_entries_of_pairs(maps)[padded].ravel(), dtype=int, device=device)
        elements.mu, elements.lam, elements.damping_time = material.mu, material.lam, material.damping_time
        self.elements = elements
        """The mesh as the kernels read it."""
        self._no_segments = _no_segments(device)
        self._muscles: _Muscles | None = None
        self._no_start = empty(0, real, device)
        self._positions, self._positions_array = _shared((len(maps.corner_offsets) - 1, 3), device)
        self._gradient, self._gradient_array = _shared(self._positions.shape, device)
        self._energy, self._energy_array = _shared((1,), device)
        self._determinants, self._determinants_array = _shared((len(padded),), device)
        self._entries, self._entries_array = _shared((maps.upper_pattern.nnz,), device)

    def start(self, positions: np.ndarray) -> wp.array:
        """Return F^T F of all elements at ``positions`` (N, 3), the reference of the damping of a step."""
        start = empty(6 * len(self._determinants), real, self._device)
        self._positions[:] = positions
        launch_cached(
            kernels.starts_kernel,
            1,
            inputs=[self.elements, self._positions_array],
            outputs=[start],
            device=self._device,
        )
        return start

    def _inputs(self, positions: np.ndarray, damping: Damping | None) -> list:
        self._positions[:] = positions
        step = [self._no_start, 0.0] if damping is None else [damping.start, damping.dt]
        return [self._positions_array, *step]

    def energy(self, positions: np.ndarray, damping: Damping | None) -> tuple[float, np.ndarray]:
        """Return the energy, J, and det F (T,)."""
        launch_cached(
            kernels.energy_kernel,
            1,
            inputs=[self.elements, *self._inputs(positions, damping)],
            outputs=[self._energy_array, self._determinants_array],
            device=self._device,
        )
        return float(self._energy[0]), self._determinants[: self._tet_count].copy()

    def energy_and_gradient(self, positions: np.ndarray, damping: Damping | None) -> tuple[float, np.ndarray]:
        """Return the energy, J, and its gradient (N, 3), N, of elasticity and damping."""
        return self.energy(positions, damping)[0], self.gradient(positions, damping, None)

    def gradient(self, positions: np.ndarray, damping: Damping | None, tension: MuscleEnergy | None) -> np.ndarray:
        """Return the gradient (N, 3), N, of elasticity, damping and muscles."""
        segments = self.lines_of(tension)
        launch_cached(
            kernels.gradient_kernel,
            1,
            inputs=[self.elements, segments, *self._inputs(positions, damping)],
            outputs=[self._gradient_array],
            device=self._device,
        )
        return self._gradient.copy()

    def lines_of(self, tension: MuscleEnergy | None) -> Any:
        """Return the kernels' struct of the segments of ``tension``, with no segments if it is None."""
        if tension is None:
            return self._no_segments
        if self._muscles is None or self._muscles.rows is not tension.rows:
            self._muscles = _Muscles(tension, self._device)
        self._muscles.tensions[:] = tension.tensions
        return self._muscles.segments

    def hessian_entries(
        self, positions: np.ndarray, damping: Damping | None, *, factor: float, projected: bool
    ) -> np.ndarray:
        """Return the upper entries (nnz,) of ``factor`` times the Hessian; see ``ElasticAssembly.hessian_entries``."""
        launch_cached(
            kernels.hessian_kernel,
            1,
            inputs=[
                self.elements,
                *self._inputs(positions, damping),
                factor,
                int(projected),
                DIAGONAL_TOLERANCE,
                MAX_SWEEPS,
            ],
            outputs=[self._entries_array],
            device=self._device,
        )
        return self._entries.copy()


class _Muscles:
    """Segments of one set of muscles as the kernels read them."""

    def __init__(self, tension: MuscleEnergy, device: wp.Device) -> None:
        self.rows = tension.rows
        self.tensions, array = _shared(tension.tensions.shape, device)
        self.segments = _no_segments(device)
        self.segments.offsets, self.segments.nodes = (
            wp.array(part.astype(np.int32), dtype=int, device=device) for part in (self.rows.indptr, self.rows.indices)
        )
        self.segments.weights, self.segments.rest_lengths = (
            wp.array(part, dtype=real, device=device) for part in (self.rows.data, tension.rest_lengths)
        )
        self.segments.tensions = array


def _no_segments(device: wp.Device) -> Any:
    segments = kernels.MuscleSegments()
    segments.offsets, segments.nodes = empty(0, int, device), empty(0, int, device)
    segments.weights, segments.rest_lengths, segments.tensions = (empty(0, real, device) for _ in range(3))
    segments.length_zero_force, segments.length_full_force = LENGTH_ZERO_FORCE, LENGTH_FULL_FORCE
    return segments


def _shared(shape: tuple[int, ...], device: wp.Device) -> tuple[np.ndarray, wp.array]:
    values = np.zeros(shape)
    return values, wp.array(values, dtype=real, device=device, copy=False)


def _entries_of_pairs(maps: AssemblyTopology) -> np.ndarray:
    """Return the matrix entries (T, 78) int32 of each element (``kernels.Elements.entries``)."""
    tets, count = maps.tets.astype(np.int64), len(maps.corner_offsets) - 1
    i, k = np.divmod(np.arange(9), 3)
    parts = []
    for a, b in kernels.PAIRS:
        one, other = tets[:, a], tets[:, b]
        block = np.searchsorted(maps.block_keys, np.minimum(one, other) * count + np.maximum(one, other))
        # A block below the diagonal is the transpose of the one above.
        order = np.where((one <= other)[:, None], 3 * i + k, 3 * k + i)
        entries = np.take_along_axis(maps.entry_from_block[block], order, axis=1)
        parts.append(entries[:, i <= k] if a == b else entries)
    return np.hstack(parts).astype(np.int32)
