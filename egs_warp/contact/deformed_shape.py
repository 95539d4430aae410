"""Body with a level set in its current pose, for queries at points near the body
(``kernels/contact/pair_contact.py``).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.kernels.contact import pair_contact as kernels
from egs_warp.launching import copy_into, empty, launch_cached, zeros
from egs_warp.meshing.level_set import LevelSet
from egs_warp.precision import Vec3

_STRETCH = 1.01
"""Upper bound of the stretch of a prop, whose single tetrahedron maps points outside of it as well."""


class DeformedShape:
    """Level set of a body, and its deformed tetrahedra in a bounding volume hierarchy."""

    def __init__(
        self, mesh: TetMesh, rest_positions: np.ndarray, level_set: LevelSet, *, margin: float, device: wp.Device
    ) -> None:
        """Create the shape in its rest pose.

        Args:
            mesh: cage.
            rest_positions: (N, 3) m, nodes of the cage at rest in the frame of the level set.
            level_set: level set of the shape at rest.
            margin: m, distance from the tetrahedra up to which queries find them.
            device: device of the arrays.
        """
        self.device, self._margin = device, margin
        self.positions = wp.array(mesh.nodes[None], dtype=Vec3, device=device)
        """(1, N) m, current positions of the nodes."""
        self.version = 0
        """Number of changes of the positions."""
        self._tets = wp.array(mesh.tets, dtype=wp.vec4i, device=device)
        self.boxes = [empty(len(mesh.tets), wp.vec3, device) for _ in range(2)]
        """Lower and upper corners of the tetrahedra's bounding boxes, inflated by the margin."""
        self._compute_boxes()
        lowers, uppers = self.boxes
        self.hierarchy = wp.Bvh(lowers, uppers, groups=zeros(len(mesh.tets), int, device))
        rest = wp.array(rest_positions[None], dtype=Vec3, device=device)
        self.inputs: list[Any] = [
            *(self._tets, rest, self.hierarchy.id, level_set.lattice),
            level_set.on_device(device),
        ]
        """Constant arguments of the kernels: tetrahedra, rest positions, hierarchy, lattice and coefficients."""

    def place(self, positions: np.ndarray) -> None:
        """Move the nodes to ``positions`` (N, 3) m, unless they are there."""
        if np.array_equal(self.positions.numpy()[0], positions):
            return
        self.version += 1
        copy_into(self.positions, positions[None])
        self._compute_boxes()
        self.hierarchy.refit()

    def _compute_boxes(self) -> None:
        inputs = [self._tets, self._margin, self.positions]
        launch_cached(
            kernels.tet_boxes_kernel, (1, len(self._tets)), inputs=inputs, outputs=self.boxes, device=self.device
        )


def protrusion(mesh: TetMesh, weights: np.ndarray) -> float:
    """Return an upper bound, in metres, of the distance between the contact points of a prop and its tetrahedron, for
    the barycentric ``weights`` (P, 4) of the points. The bound is 0 for a cage of several tetrahedra, which encloses
    the body."""
    if len(mesh.tets) > 1:
        return 0.0
    inside = np.maximum(weights, 0.0)
    inside /= inside.sum(axis=1, keepdims=True)
    offsets = (weights - inside) @ mesh.nodes[mesh.tets[0]]
    return _STRETCH * float(np.linalg.norm(offsets, axis=1).max())
