"""Files of Gaussians (.ply) in the layouts of other tools, built column by column."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from egs_warp.geometry.gaussians import GaussianCloud

TYPES = {
    **{"f4": "float", "f8": "double", "f2": "half"},
    **{"u1": "uchar", "i1": "char", "u2": "ushort", "i2": "short", "u4": "uint", "i4": "int"},
}


def columns_of(cloud: GaussianCloud) -> dict[str, np.ndarray]:
    """Return the properties of the INRIA layout, float32, in its order."""
    sh: np.ndarray = cloud.sh.numpy()
    rest = (cloud.sh_degree + 1) ** 2 - 1
    columns = dict(zip("xyz", cloud.means.numpy().T, strict=True))
    columns |= {f"f_dc_{c}": sh[:, 0, c] for c in range(3)}
    columns |= {f"f_rest_{c * rest + k}": sh[:, 1 + k, c] for c in range(3) for k in range(rest)}
    columns |= {"opacity": cloud.opacity_logits.numpy()}
    columns |= {f"scale_{k}": values for k, values in enumerate(cloud.log_scales.numpy().T)}
    return columns | {f"rot_{k}": values for k, values in enumerate(cloud.rotations.numpy().T)}


def without(columns: Mapping[str, np.ndarray], *beginnings: str) -> dict[str, np.ndarray]:
    """Return the columns whose names begin with none of ``beginnings``."""
    return {name: values for name, values in columns.items() if not name.startswith(beginnings)}


def ply_of(
    columns: Mapping[str, np.ndarray],
    *,
    comments: Sequence[str] = (),
    kinds: Mapping[str, str] | str = "f4",
    layout: str = "binary_little_endian",
    newline: str = "\n",
) -> bytes:
    """Return a .ply with one element ``vertex``; ``kinds`` are the NumPy types of all columns, or of some by name."""
    order = ">" if layout == "binary_big_endian" else "<"
    kind = {name: kinds if isinstance(kinds, str) else kinds.get(name, "f4") for name in columns}
    count = len(next(iter(columns.values())))
    header = ["ply", f"format {layout} 1.0", *(f"comment {text}" for text in comments), f"element vertex {count}"]
    header += [f"property {TYPES[kind[name]]} {name}" for name in columns] + ["end_header", ""]
    rows = np.empty(count, [(name, order + kind[name]) for name in columns])
    for name, values in columns.items():
        rows[name] = values
    body = rows.tobytes()
    if layout == "ascii":
        body = "".join(" ".join(str(value) for value in row) + newline for row in rows.tolist()).encode()
    return newline.join(header).encode() + body
