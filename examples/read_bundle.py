"""Read the one file that ``egs-warp export RUN --to bundle`` writes; needs numpy alone (docs/guide/export.md)."""

from __future__ import annotations

import sys

import numpy as np


class Bundle:
    """Rest splats, their cage, and where its nodes are in each frame; metres, z up."""

    def __init__(self, path: str) -> None:
        with np.load(path, allow_pickle=False) as data:
            self.arrays = {name: data[name] for name in data.files}
        a = self.arrays
        w, x, y, z = a["rotations"].astype(float).T
        rows = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]]
        rows += [[2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]]
        rows += [[2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]
        self.axes = np.moveaxis(np.array(rows), 2, 0)  # (n, 3, 3), columns are the axes of each splat
        self.scales = np.exp(a["log_scales"].astype(float))
        self.corners = a["rest_nodes"][a["tets"]].astype(float)
        self.inverse = np.linalg.inv((self.corners[:, 1:] - self.corners[:, :1]).transpose(0, 2, 1))

    def frame(self, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Means (n, 3), covariances (n, 3, 3) and turns (n, 3, 3) of the splats: seen along d, a splat has the colour
        that its ``sh`` gives along turn^T d.
        """
        a = self.arrays
        moved = a["nodes"][index][a["tets"]].astype(float)
        gradients = (moved[:, 1:] - moved[:, :1]).transpose(0, 2, 1) @ self.inverse
        tet, rest = a["mean_tets"], a["means"].astype(float)

        def image(tets: np.ndarray, points: np.ndarray) -> np.ndarray:
            return moved[tets, 0] + np.einsum("nij,nj->ni", gradients[tets], points - self.corners[tets, 0])

        means, through = image(tet, rest), gradients[tet] @ self.axes
        rigid = np.flatnonzero(a["rigid"])  # far outside the cage: turned, not stretched
        turned = _rotations(gradients[tet[rigid]])
        arms = rest[rigid] - self.corners[tet[rigid], 0]
        means[rigid] = moved[tet[rigid], 0] + np.einsum("nij,nj->ni", turned, arms)
        through[rigid] = turned @ self.axes[rigid]
        rows, stretched = a["arm_rows"], through.copy()  # across several tetrahedra: each end by its own
        sides = np.zeros((2, len(rows), 3, 3))
        for k in range(6):
            end, share = a["arm_tets"][k], a["arm_shares"][k][:, None]
            sign = 1.0 if k < 3 else -1.0
            axis, inner = sign * self.axes[rows, :, k % 3], sign * through[rows, :, k % 3]
            there = np.einsum("nij,nj->ni", gradients[end], axis)
            length = np.where(share < 0, share, -1.0)
            bridged = there - (image(end, rest[rows]) - means[rows]) / length
            limit = a["max_stretch"] * np.maximum(np.linalg.norm(inner, axis=1), np.linalg.norm(there, axis=1))
            bridged *= np.minimum(1.0, limit / np.maximum(np.linalg.norm(bridged, axis=1), 1e-30))[:, None]
            arm = np.where(share < 0, bridged, share * inner + (1.0 - share) * there)
            sides[k // 3, :, :, k % 3] = sign * np.where((end == tet[rows])[:, None], inner, arm)
        average = sides.mean(axis=0)
        upright = np.linalg.det(average) > 0
        stretched[rows[upright]] = average[upright]
        means[rows] += np.einsum("kn,nik->ni", a["arm_bulges"], sides[0] - sides[1])
        factors = stretched * self.scales[:, None, :]
        own = _rotations(gradients)[tet]
        own[rows[upright]] = _rotations(average[upright]) @ self.axes[rows[upright]].transpose(0, 2, 1)
        return means, factors @ factors.transpose(0, 2, 1), own


def _rotations(matrices: np.ndarray) -> np.ndarray:
    left, _, right = np.linalg.svd(matrices)
    left[..., -1] *= np.linalg.det(left @ right)[..., None]
    return left @ right


if __name__ == "__main__":
    bundle = Bundle(sys.argv[1])
    count = len(bundle.arrays["nodes"])
    print(f"{len(bundle.scales)} splats, {count} frames at {float(bundle.arrays['fps']):g} a second")
    for shown in (0, count - 1):
        print(f"frame {shown}: middle {bundle.frame(shown)[0].mean(axis=0).round(4).tolist()}")
