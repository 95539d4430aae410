"""States of a body far from rest: rotated, bent, thrown and spinning."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.fem.body import BodyState, SoftBody


def spinning_state(body: SoftBody) -> BodyState:
    random = np.random.default_rng(0)
    x = body.mesh.nodes * [1.03, 0.97, 0.95]
    x = x @ Rotation.from_rotvec([0.2, -0.4, 0.9]).as_matrix().T + 0.002 * random.standard_normal(x.shape)
    arms = x - body.centre_of_mass(x)
    return BodyState(x, np.cross([0.5, -1.0, 4.0], arms) + 0.05 * random.standard_normal(x.shape) + [1.0, 0.0, 2.0])


def bent_state(body: SoftBody, *, seed: int = 0) -> BodyState:
    rng = np.random.default_rng(seed)
    x = body.mesh.nodes * [1.05, 0.95, 0.9]
    x = x @ Rotation.from_rotvec([0.2, -0.4, 0.9]).as_matrix().T + 0.005 * rng.standard_normal(x.shape)
    return BodyState(x, rng.standard_normal(x.shape) * 0.3 + [1.0, 0.0, 2.0])
