"""Contact shadows of bodies on each other: a body darkens the Gaussians of another body that are close to it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from egs_warp.contact.deformed_shape import DeformedShape, protrusion
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.kernels.contact import occlusion as kernels
from egs_warp.launching import launch_rows
from egs_warp.meshing.level_set import LevelSet
from egs_warp.short_repr import short_repr

OCCLUSION_FILE = Path(__file__).with_name("occlusion.json")
"""Settings of the shadows, which films and the page (``web/client/src/body_shadows.ts``) share.

``max_opacity`` is the opacity of the shadow of a touching surface that hides the whole sky. ``reach`` is the gap at
which a shadow has 1/e of its opacity, in heights of the occluding body. ``cutoff`` is the gap beyond which there is no
shadow, as a multiple of the reach.
"""
_SETTINGS = json.loads(OCCLUSION_FILE.read_text("utf-8"))
_MAX_OPACITY, _REACH, _CUTOFF = (float(_SETTINGS[name]) for name in ("max_opacity", "reach", "cutoff"))


@dataclass(frozen=True)
class OccludingBody:
    """Shape of a body that casts contact shadows on other bodies."""

    __repr__ = short_repr

    mesh: TetMesh
    """Cage at rest, in the frame of the level set."""
    point_tets: np.ndarray
    """(P,) int, tetrahedron of each contact point."""
    point_weights: np.ndarray
    """(P, 4) barycentric weights of each contact point."""
    level_set: LevelSet
    """Level set of the shape at rest."""
    height: float
    """Height of the body, m."""

    def points(self, positions: np.ndarray) -> np.ndarray:
        """Return the contact points (P, 3) m for nodal ``positions`` (N, 3) m."""
        return np.einsum("pw,pwi->pi", self.point_weights, positions[self.mesh.tets[self.point_tets]])


class BodyShadows:
    """Contact shadows of each body on all other bodies, drawn into a joint cloud of all bodies."""

    def __init__(self, bodies: Sequence[OccludingBody], counts: Sequence[int], device: wp.Device) -> None:
        """Prepare the shadows of the ``bodies``, whose ``counts`` Gaussians are stored body after body."""
        self._bodies = tuple(bodies)
        self._rows = [slice(end - count, end) for count, end in zip(counts, np.cumsum(counts).tolist(), strict=True)]
        self._reaches = [_REACH * body.height for body in bodies]
        self._shapes = [
            DeformedShape(
                body.mesh,
                body.mesh.nodes,
                body.level_set,
                margin=_CUTOFF * reach + protrusion(body.mesh, body.point_weights),
                device=device,
            )
            for body, reach in zip(bodies, self._reaches, strict=True)
        ]

    def draw(self, joint: GaussianCloud, poses: Sequence[np.ndarray]) -> None:
        """Darken the Gaussians of the ``joint`` cloud, for nodal positions ``poses`` (N, 3) m of each body."""
        boxes = []
        for body, positions in zip(self._bodies, poses, strict=True):
            points = body.points(positions)
            boxes.append((points.min(axis=0), points.max(axis=0)))
        for a, (shape, reach, (low, high)) in enumerate(zip(self._shapes, self._reaches, boxes, strict=True)):
            margin = _CUTOFF * reach
            low, high = low - margin, high + margin
            near = [b for b, box in enumerate(boxes) if b != a and (box[0] < high).all() and (box[1] > low).all()]
            if near:
                shape.place(poses[a])
            for b in near:
                rows = self._rows[b]
                means: Any = joint.means[rows]
                sh: Any = joint.sh[rows]
                launch_rows(
                    kernels.occlude_kernel,
                    len(means),
                    inputs=[
                        *(*shape.inputs, _MAX_OPACITY, reach, shape.positions),
                        *(wp.vec3(*low.tolist()), wp.vec3(*high.tolist()), means),
                    ],
                    outputs=[sh],
                    device=shape.device,
                )
