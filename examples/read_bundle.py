"""Read a file that ``egs-warp export RUN --to bundle`` has written, with NumPy alone (docs/concepts/bundle.md)."""

import argparse
import functools
import json
import zlib

import numpy as np

_apply = functools.partial(np.einsum, "...j,...ji->...i")


class Bundle:
    """Body of a bundle: splats at rest, their cage, and the positions (F, N, 3) of the cage's nodes in each frame."""

    def __init__(self, path: str, body: int = 0) -> None:
        with open(path, "rb") as file:
            assert file.read(8) == b"EGSB\2\0\0\0", f"{path}: not a bundle of version 2"
            self.text, self._data = json.loads(file.read(int.from_bytes(file.read(4), "little"))), file.read()
        self.body = self.text["bodies"][body]
        a = self.arrays = {name: self._numbers(entry) for name, entry in self.body["arrays"].items()}
        stored = np.concatenate([self._numbers(block["arrays"]["residuals"]) for block in self.body["blocks"]])
        moved = np.where(stored % 2 == 1, -1.0 - stored // 2, stored // 2).reshape(-1, len(a["order"]), 3)
        for k, (parents, weights) in enumerate(zip(a["parents"], a["weights"], strict=True)):
            moved[:, k] += np.floor(0.5 + np.einsum("p,fpi->fi", weights, moved[:, parents]))
        rest = np.floor(a["rest_nodes"].astype(float) / self.body["node_step"] + 0.5)
        self.nodes = self.body["node_step"] * (rest + np.cumsum(moved[:, np.argsort(a["order"])], axis=0))
        self._prepare(a)

    def _prepare(self, a: dict[str, np.ndarray]) -> None:
        angles, v = np.linalg.norm(a["rotations"], axis=1)[:, None, None] / np.pi, a["rotations"][:, None]
        once, twice = np.cross(v, np.eye(3)), np.cross(v, np.cross(v, np.eye(3)))
        self.axes = np.eye(3) + np.sinc(angles) * once + 0.5 * np.sinc(0.5 * angles) ** 2 * twice  # (n, 3, 3), rows
        self.corners = a["rest_nodes"][a["cage_tets"]].astype(float)

    def _numbers(self, entry: dict) -> np.ndarray:
        planes = np.frombuffer(zlib.decompress(self._data[entry["offset"] :][: entry["bytes"]]), np.uint8)
        stored = planes.reshape(-1, max(entry["shape"][0], 1)).T.copy().view(entry["type"]).reshape(entry["shape"])
        return np.array(entry["lower"]) + np.array(entry["step"]) * stored if "step" in entry else stored

    def frame(self, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return means (n, 3), covariances (n, 3, 3) and rotations R (n, 3, 3) of the splats in frame ``index``.

        A tetrahedron maps a row vector v to v @ map. The colour in direction d is ``bands`` in direction d @ R.
        """
        a, tet, rows = self.arrays, self.arrays["tets"], np.flatnonzero(self.arrays["carriers"] == 1)
        moved = self.nodes[index][a["cage_tets"]]
        maps = np.linalg.inv(self.corners[:, 1:] - self.corners[:, :1]) @ (moved[:, 1:] - moved[:, :1])
        turns, deviations = _rotations(maps)[tet], np.exp(a["log_scales"])
        own = np.where(a["carriers"][:, None, None] == 2, turns, maps[tet])
        means = moved[tet, 0] + _apply(a["means"] - self.corners[tet, 0], own)
        axes, signs = self.axes @ own, np.repeat([1.0, -1.0], 3)[:, None]
        end = a["arm_tets"] + tet[rows, None].astype(a["arm_tets"].dtype)
        inner = signs * np.tile(axes[rows], (1, 2, 1))  # (r, 6, 3), the ends of the axes, + + + - - -
        outer = signs * _apply(np.tile(self.axes[rows], (1, 2, 1)), maps[end])
        image = moved[end, 0] + _apply(a["means"][rows, None] - self.corners[end, 0], maps[end])
        length, share = a["arm_lengths"] * np.tile(deviations[rows], 2), a["arm_shares"][:, :, None]
        bridge = outer + (image - means[rows, None]) / np.where(length > 0, length, 1.0)[:, :, None]
        limit = self.body["max_stretch"] * np.maximum(*(np.linalg.norm(arm, axis=2) for arm in (inner, outer)))
        bridge *= np.minimum(1.0, limit / np.maximum(np.linalg.norm(bridge, axis=2), 1e-30))[:, :, None]
        arm = np.where(length[:, :, None] > 0, bridge, share * inner + (1.0 - share) * outer)
        plus, minus = np.split(signs * np.where((end == tet[rows, None])[:, :, None], inner, arm), 2, axis=1)
        means[rows] += _apply(a["arm_bulges"] * deviations[rows], plus - minus)
        upright = np.linalg.det(plus + minus) > 0
        axes[rows[upright]] = 0.5 * (plus + minus)[upright]
        turns[rows[upright]] = np.linalg.inv(self.axes[rows[upright]]) @ _rotations(axes[rows[upright]])
        return means, np.einsum("nk,nki,nkj->nij", deviations**2, axes, axes), turns.swapaxes(1, 2)


def _rotations(maps: np.ndarray) -> np.ndarray:
    left, _, right = np.linalg.svd(maps)
    left[..., -1] *= np.linalg.det(left @ right)[..., None]
    return left @ right


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bundle", help=".egs file")
    found = Bundle(parser.parse_args().bundle)
    print(f"{len(found.arrays['means'])} splats, {len(found.nodes)} frames at {found.text['rate']:g} a second")
