"""Slow reference renderer in NumPy and float64, which renders one pixel at a time without tiles."""

from __future__ import annotations

import numpy as np

from egs_warp.geometry.camera import Camera


def rotation_matrices(q: np.ndarray) -> np.ndarray:
    """Return the rotation matrices (n, 3, 3) of quaternions (n, 4) w, x, y, z, which are normalised first."""
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        1,
    )


def sh_basis(d: np.ndarray) -> np.ndarray:
    """Return the real spherical harmonics (n, 16) of the unit directions (n, 3), with the signs of the INRIA code."""
    x, y, z = d.T
    root = np.sqrt
    pi = np.pi
    return np.stack(
        [
            np.full_like(x, root(1 / (4 * pi))),
            -root(3 / (4 * pi)) * y,
            root(3 / (4 * pi)) * z,
            -root(3 / (4 * pi)) * x,
            root(15 / (4 * pi)) * x * y,
            -root(15 / (4 * pi)) * y * z,
            root(5 / (16 * pi)) * (3 * z * z - 1),
            -root(15 / (4 * pi)) * x * z,
            root(15 / (16 * pi)) * (x * x - y * y),
            -root(35 / (32 * pi)) * y * (3 * x * x - y * y),
            root(105 / (4 * pi)) * x * y * z,
            -root(21 / (32 * pi)) * y * (5 * z * z - 1),
            root(7 / (16 * pi)) * z * (5 * z * z - 3),
            -root(21 / (32 * pi)) * x * (5 * z * z - 1),
            root(105 / (16 * pi)) * z * (x * x - y * y),
            -root(35 / (32 * pi)) * x * (x * x - 3 * y * y),
        ],
        1,
    )


def render_twin(
    values: dict[str, np.ndarray],
    camera: Camera,
    *,
    background: np.ndarray | tuple[float, float, float] = (1.0, 1.0, 1.0),
    antialiased: bool = False,
) -> dict[str, np.ndarray]:
    """Render the Gaussians in ``values``, which are the fields of the cloud by name.

    Returns:
        Colour (H, W, 3), alpha, expected and median depth (H, W), and normal (H, W, 3), by name.
    """
    m, q, log_scales, logits, sh = (
        np.asarray(values[k], dtype=np.float64) for k in ("means", "rotations", "log_scales", "opacity_logits", "sh")
    )
    p = m @ camera.rotation.T + camera.translation
    opacity = 1 / (1 + np.exp(-logits))
    directions = m - camera.centre
    directions = directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-30)
    colour = np.maximum(np.einsum("nk,nkc->nc", sh_basis(directions)[:, : sh.shape[1]], sh) + 0.5, 0)
    axes = rotation_matrices(q)
    covariance = np.einsum("nij,nj,nkj->nik", axes, np.exp(2 * log_scales), axes)
    # The normal is the thinnest axis in camera coordinates, pointing towards the camera.
    thinnest = axes[np.arange(len(m)), :, np.argmin(log_scales, axis=1)] @ camera.rotation.T
    thinnest *= -np.sign(np.einsum("ni,ni->n", thinnest, p))[:, None]
    shape = (camera.height, camera.width)
    passing, done = np.ones(shape), np.zeros(shape, bool)
    sums, normal, median = np.zeros((*shape, 4)), np.zeros((*shape, 3)), np.zeros(shape)
    py, px = np.mgrid[: camera.height, : camera.width] + 0.5
    for g in np.argsort(p[:, 2].astype(np.float32), kind="stable"):
        x, y, z = p[g]
        if not camera.near <= z <= camera.far:
            continue
        margin_x, margin_y = 0.15 * camera.width / camera.fx, 0.15 * camera.height / camera.fy
        sx = np.clip(x / z, -camera.cx / camera.fx - margin_x, (camera.width - camera.cx) / camera.fx + margin_x)
        sy = np.clip(y / z, -camera.cy / camera.fy - margin_y, (camera.height - camera.cy) / camera.fy + margin_y)
        jacobian = np.array(
            [[camera.fx / z, 0, -camera.fx * sx / z], [0, camera.fy / z, -camera.fy * sy / z]],
        )
        to_screen = jacobian @ camera.rotation
        sharp = to_screen @ covariance[g] @ to_screen.T
        blurred = sharp + 0.3 * np.eye(2)
        peak = opacity[g]
        if antialiased:
            peak *= np.sqrt(max(np.linalg.det(sharp) / np.linalg.det(blurred), 1e-12))
        offset = np.stack([px - (camera.fx * x / z + camera.cx), py - (camera.fy * y / z + camera.cy)], -1)
        power = 0.5 * np.einsum("hwi,ij,hwj->hw", offset, np.linalg.inv(blurred), offset)
        alpha = np.minimum(peak * np.exp(-power), 0.999)
        after = passing * (1 - alpha)
        visible = (alpha >= 1 / 255) & ~done
        done |= visible & (after <= 1e-4)
        visible &= ~done
        weight = np.where(visible, passing * alpha, 0)
        median = np.where(visible & (passing > 0.5) & (after <= 0.5), z, median)
        passing = np.where(visible, after, passing)
        sums += weight[..., None] * np.append(colour[g], z)
        normal += weight[..., None] * thinnest[g]
    opaque = 1 - passing
    return {
        "colour": sums[..., :3] + passing[..., None] * np.broadcast_to(np.asarray(background), (*shape, 3)),
        "alpha": opaque,
        "depth": np.divide(sums[..., 3], opaque, out=np.zeros(shape), where=opaque > 0),
        "median_depth": median,
        "normal": normal,
    }
