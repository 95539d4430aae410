"""Writing of binary glTF 2.0 with splats as points: KHR_gaussian_splatting, as ratified.

Scales and opacities are stored directly, not as logarithms; quaternions are x, y, z, w. In glTF, the y axis is up; the
caller must rotate captures accordingly.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.io.atomic import atomic_write
from egs_warp.io.gltf import BINARY_CHUNK, EXTENSION, JSON_CHUNK, MAGIC
from egs_warp.version import __version__

_FLOAT = 5126
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write_glb(path: Path | str, cloud: GaussianCloud, *, origin: np.ndarray | None = None) -> None:
    """Write ``cloud``, y up, as one mesh of points. Raises ``UserError`` if the file cannot be written.

    Args:
        path: The file.
        cloud: The Gaussians.
        origin: (3,) Translation of the mesh's node (``Capture.origin``).
    """
    means, sh = cloud.means.numpy(), cloud.sh.numpy()
    opacities = cloud.opacities().astype(np.float32)[:, None]
    fallback = np.concatenate([np.clip(0.5 + SH_BAND_0 * sh[:, 0], 0.0, 1.0), opacities], axis=1)
    attributes = {
        "POSITION": means,
        "COLOR_0": fallback,
        f"{EXTENSION}:ROTATION": cloud.rotations.numpy()[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": np.exp(cloud.log_scales.numpy()),
        f"{EXTENSION}:OPACITY": opacities,
    }
    for degree in range(cloud.sh_degree + 1):
        for k in range(2 * degree + 1):
            attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k}"] = sh[:, degree**2 + k]
    pieces = [np.ascontiguousarray(values, "<f4").tobytes() for values in attributes.values()]
    starts = np.cumsum([0, *(len(piece) for piece in pieces)]).tolist()
    accessors: list[dict[str, object]] = [
        {"bufferView": k, "componentType": _FLOAT, "count": cloud.count, "type": _KINDS[values.shape[1]]}
        for k, values in enumerate(attributes.values())
    ]
    accessors[0] |= {"min": means.min(axis=0).tolist(), "max": means.max(axis=0).tolist()}
    splats: dict[str, object] = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    splats |= {"sortingMethod": "cameraDistance", "projection": "perspective"}
    if cloud.antialiased:
        # The extension has no property for antialiasing.
        splats |= {"extras": {"antialiased": True}}
    node: dict[str, object] = {"mesh": 0, "name": "creature"}
    if origin is not None:
        node["translation"] = origin.tolist()
    write_container(
        path,
        {
            "extensionsUsed": [EXTENSION],
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [node],
            "meshes": [
                {
                    "primitives": [
                        {
                            "mode": 0,
                            "attributes": {name: k for k, name in enumerate(attributes)},
                            "extensions": {EXTENSION: splats},
                        }
                    ]
                }
            ],
            "accessors": accessors,
            "bufferViews": [
                {"buffer": 0, "byteOffset": start, "byteLength": len(piece), "target": 34962}
                for start, piece in zip(starts, pieces, strict=False)
            ],
        },
        b"".join(pieces),
    )


def write_container(path: Path | str, text: Mapping[str, object], binary: bytes) -> None:
    """Write a binary glTF file. Raises ``UserError`` if it cannot be written.

    Args:
        path: The file.
        text: Properties of the JSON chunk; ``asset`` and ``buffers`` are added.
        binary: Content of the binary chunk.
    """
    asset = {"version": "2.0", "generator": f"egs_warp {__version__}"}
    encoded = json.dumps({"asset": asset, **text, "buffers": [{"byteLength": len(binary)}]}).encode()
    encoded += b" " * (-len(encoded) % 4)
    padded = binary + b"\0" * (-len(binary) % 4)
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        file.write(np.array([MAGIC, 2, 28 + len(encoded) + len(padded), len(encoded), JSON_CHUNK], "<u4").tobytes())
        file.write(encoded)
        file.write(np.array([len(padded), BINARY_CHUNK], "<u4").tobytes())
        file.write(padded)
