"""Elasticity on a CPU, four elements at a time; launches the kernels of ``egs_warp.kernels.fem.elasticity_cpu``."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sparse
import warp as wp

from egs_warp.fem.assembly_topology import AssemblyTopology, Material
from egs_warp.kernels.fem import elasticity_cpu as kernels
from egs_warp.kernels.fem.elasticity import DIAGONAL_TOLERANCE, MAX_SWEEPS
from egs_warp.kernels.fem.element_groups import LANES, PAIRS, Elements, MuscleSegments
from egs_warp.launching import PinnedMirror, empty, launch_cached, zeros
from egs_warp.muscles.tension import LENGTH_FULL_FORCE, LENGTH_ZERO_FORCE
from egs_warp.precision import real


class SimdSegments:
    """Segments of one set of muscles in the layout of the kernels."""

    def __init__(self, rows: sparse.csr_matrix, rest_lengths: np.ndarray, device: wp.Device) -> None:
        self.rows = rows
        self.tensions = PinnedMirror(zeros(len(rest_lengths), real, device))
        """(M,) N, tensions, which the host sets."""
        self.struct = MuscleSegments()
        self.struct.offsets, self.struct.nodes = (
            wp.array(part.astype(np.int32), dtype=int, device=device) for part in (rows.indptr, rows.indices)
        )
        self.struct.weights, self.struct.rest_lengths = (
            wp.array(part, dtype=real, device=device) for part in (rows.data, rest_lengths)
        )
        self.struct.tensions = self.tensions.array
        self.struct.length_zero_force, self.struct.length_full_force = LENGTH_ZERO_FORCE, LENGTH_FULL_FORCE


class SimdElasticity:
    """``WarpElasticity`` of one world on a CPU: arrays in groups of four elements, and scratch memory."""

    def __init__(self, maps: AssemblyTopology, material: Material, device: wp.Device) -> None:
        self._device, self._node_count, tet_count = device, len(maps.corner_offsets) - 1, len(maps.tets)
        more = -tet_count % LANES
        # The last group is filled with copies of the last element that have zero volume.
        padded = np.r_[np.arange(tet_count), np.full(more, tet_count - 1)]
        groups = len(padded) // LANES
        rests = maps.rest_inverses[padded].reshape(groups, LANES, 9).transpose(0, 2, 1)
        elements = Elements()
        elements.corners = wp.array(maps.tets[padded].ravel(), dtype=int, device=device)
        elements.rests = wp.array(np.ascontiguousarray(rests).ravel(), dtype=real, device=device)
        elements.volumes = wp.array(
            np.r_[material.weighted_volumes(maps.volumes), np.zeros(more)], dtype=real, device=device
        )
        elements.entries = wp.array(_entries_of_pairs(maps)[padded].ravel(), dtype=int, device=device)
        elements.mu, elements.lam, elements.damping_time = material.mu, material.lam, material.damping_time
        self.elements = elements
        """Elements of the mesh in the layout of the kernels."""
        self._no_segments = self.segments(sparse.csr_matrix((0, self._node_count)), np.zeros(0)).struct
        self._no_start = empty(0, real, device)
        self.energy_offset = len(padded)
        self.determinants_and_energies = zeros(self.energy_offset + 1, real, device)
        both: Any = self.determinants_and_energies
        self._determinants, self._energy = both[: self.energy_offset], both[self.energy_offset :]
        self._entries = zeros(maps.upper_pattern.nnz, real, device)

    def node_vectors(self) -> wp.array:
        """Return an array (N, 3) of zeros."""
        return zeros((self._node_count, 3), real, self._device)

    def new_start(self) -> wp.array:
        """Return an array for F^T F of all elements at the start of a step."""
        return empty(6 * self.energy_offset, real, self._device)

    def segments(self, rows: sparse.csr_matrix, rest_lengths: np.ndarray) -> SimdSegments:
        """Return muscle segments with difference ``rows`` (M, N) and ``rest_lengths`` (M,) m."""
        return SimdSegments(rows, rest_lengths, self._device)

    def struct_of(self, segments: SimdSegments | None) -> Any:
        """Return the kernels' struct of ``segments``; for None, a struct without segments."""
        return self._no_segments if segments is None else segments.struct

    def _launch(self, kernel: Any, inputs: list[Any], outputs: list[Any]) -> None:
        launch_cached(kernel, 1, inputs=[self.elements, *inputs], outputs=outputs, device=self._device)

    def _state(self, positions: wp.array, start: wp.array | None, dt: float) -> list[Any]:
        return [positions, self._no_start if start is None else start, dt]

    def enqueue_start(self, positions: wp.array, start: wp.array) -> None:
        """Compute F^T F of all elements at ``positions`` (N, 3) m, the reference state of the damping of a step."""
        self._launch(kernels.starts_kernel, [positions], [start])

    def enqueue_energies(self, positions: wp.array, start: wp.array | None, dt: float) -> tuple[wp.array, wp.array]:
        """Compute the energy (1,) J and the determinants of the elements; see ``WarpElasticity``."""
        self._launch(kernels.energy_kernel, self._state(positions, start, dt), [self._energy, self._determinants])
        return self._energy, self._determinants

    def enqueue_gradient(
        self, positions: wp.array, start: wp.array | None, dt: float, segments: SimdSegments | None, gradient: wp.array
    ) -> None:
        """Compute the ``gradient`` (N, 3), N; see ``WarpElasticity``."""
        inputs = [self.struct_of(segments), *self._state(positions, start, dt)]
        self._launch(kernels.gradient_kernel, inputs, [gradient])

    def enqueue_entries(
        self, positions: wp.array, start: wp.array | None, dt: float, *, factor: float, projected: bool
    ) -> wp.array:
        """Compute the upper entries (nnz,) of ``factor`` times the Hessian; see ``WarpElasticity``."""
        options = [factor, int(projected), DIAGONAL_TOLERANCE, MAX_SWEEPS]
        self._launch(kernels.hessian_kernel, [*self._state(positions, start, dt), *options], [self._entries])
        return self._entries


def _entries_of_pairs(maps: AssemblyTopology) -> np.ndarray:
    """Return the matrix entries (T, 78) int32 of each element (``Elements.entries``)."""
    tets, count = maps.tets.astype(np.int64), len(maps.corner_offsets) - 1
    i, k = np.divmod(np.arange(9), 3)
    parts = []
    for a, b in PAIRS:
        one, other = tets[:, a], tets[:, b]
        block = np.searchsorted(maps.block_keys, np.minimum(one, other) * count + np.maximum(one, other))
        # A block below the diagonal is the transpose of its counterpart above.
        order = np.where((one <= other)[:, None], 3 * i + k, 3 * k + i)
        entries = np.take_along_axis(maps.entry_from_block[block], order, axis=1)
        parts.append(entries[:, i <= k] if a == b else entries)
    return np.hstack(parts).astype(np.int32)
