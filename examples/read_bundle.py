"""Read the file that ``egs-warp export RUN --to bundle`` writes; needs only numpy (docs/guide/export.md)."""

import sys

import numpy as np


class Bundle:
    """Splats at rest, their cage, and the positions of its nodes in each frame; metres, z up."""

    def __init__(self, path: str) -> None:
        with np.load(path, allow_pickle=False) as data:
            self.arrays = dict(data)
        w, xyz = np.split(self.arrays["rotations"].astype(float)[:, None], [1], axis=2)
        cross = np.cross(xyz, np.eye(3)).transpose(0, 2, 1)
        self.axes = np.eye(3) + 2 * (w * cross + cross @ cross)  # (n, 3, 3), columns are the axes of each splat
        self.corners = self.arrays["rest_nodes"][self.arrays["tets"]].astype(float)
        self.inverse = np.linalg.inv((self.corners[:, 1:] - self.corners[:, :1]).transpose(0, 2, 1))

    def frame(self, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return means (n, 3), covariances and rotations (n, 3, 3); colour along d is ``sh`` along rotation^T d."""
        a, tet, rows = self.arrays, self.arrays["mean_tets"], self.arrays["arm_rows"]
        moved = a["nodes"][index][a["tets"]].astype(float)
        gradients = (moved[:, 1:] - moved[:, :1]).transpose(0, 2, 1) @ self.inverse
        turns = _rotations(gradients)[tet]
        carriers = np.where(a["rigid"][:, None, None], turns, gradients[tet])  # rigid: far outside the cage
        means = moved[tet, 0] + _apply(carriers, a["means"] - self.corners[tet, 0])
        stretched = carriers @ self.axes
        through, sides = stretched[rows], np.zeros((2, len(rows), 3, 3))  # each axis end in its own tetrahedron
        for k, (end, share) in enumerate(zip(a["arm_tets"], a["arm_shares"][:, :, None], strict=True)):
            sign = 1.0 if k < 3 else -1.0
            inner, outer = sign * through[:, :, k % 3], sign * _apply(gradients[end], self.axes[rows, :, k % 3])
            image = moved[end, 0] + _apply(gradients[end], a["means"][rows] - self.corners[end, 0])
            bridged = outer + (image - means[rows]) / np.where(share < 0, -share, 1.0)
            limit = a["max_stretch"] * np.maximum(np.linalg.norm(inner, axis=1), np.linalg.norm(outer, axis=1))
            bridged *= np.minimum(1.0, limit / np.maximum(np.linalg.norm(bridged, axis=1), 1e-30))[:, None]
            arm = np.where(share < 0, bridged, share * inner + (1.0 - share) * outer)
            sides[k // 3, :, :, k % 3] = sign * np.where((end == tet[rows])[:, None], inner, arm)
        average = sides.mean(axis=0)
        upright = np.linalg.det(average) > 0
        stretched[rows[upright]] = average[upright]
        turns[rows[upright]] = _rotations(average[upright]) @ self.axes[rows[upright]].transpose(0, 2, 1)
        means[rows] += np.einsum("kn,nik->ni", a["arm_bulges"], sides[0] - sides[1])
        factors = stretched * np.exp(a["log_scales"])[:, None, :]
        return means, factors @ factors.transpose(0, 2, 1), turns


def _apply(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    return np.einsum("nij,nj->ni", matrices, vectors)


def _rotations(matrices: np.ndarray) -> np.ndarray:
    left, _, right = np.linalg.svd(matrices)
    left[..., -1] *= np.linalg.det(left @ right)[..., None]
    return left @ right


if __name__ == "__main__":
    arrays = Bundle(sys.argv[1]).arrays
    print(f"{len(arrays['means'])} splats, {len(arrays['nodes'])} frames at {float(arrays['fps']):g} a second")
