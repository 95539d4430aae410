"""A small bundle of two bodies: a moving block and static splats."""

from __future__ import annotations

import json
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.io.bundle import Bundle, BundleBody, BundleCage, BundleLevelSet, write_bundle
from egs_warp.io.bundle_file import HEAD, Carrier
from tests.support.captures import small_cloud
from tests.support.meshes import block_mesh

FRAMES = 130
"""Number of frames, which the bundle stores in two full blocks of 60 and a shorter one."""


def small_bundle() -> Bundle:
    """Return a bundle whose block travels 40 times its own height while it swings."""
    mesh, cloud = block_mesh(2, 2, 2), small_cloud()
    time = np.arange(FRAMES)[:, None, None] / 60.0
    swing = 0.2 * np.sin(7.0 * time + mesh.nodes[:, 2:]) * mesh.nodes[:, 2:]
    nodes = mesh.nodes + swing * np.array([1.0, 0.3, 0.0]) + 20.0 * time * np.array([1.0, 0.0, 0.0])
    carriers = np.array([Carrier.TET, Carrier.ARMS, Carrier.RIGID, Carrier.ARMS, *[Carrier.TET] * 3], np.uint8)
    cage = BundleCage(
        rest_nodes=mesh.nodes.astype(np.float32),
        cage_tets=mesh.tets,
        surface=mesh.boundary_faces(),
        tets=np.arange(7) % len(mesh.tets),
        carriers=carriers,
        arm_tets=np.array([[0, 1, 2, 3, 4, 5], [5, 4, 3, 2, 1, 0]]),
        arm_shares=np.full((2, 6), 0.25),
        arm_lengths=np.array([[0.0, 1.7, 0.0, 0.0, 0.62, 0.0], [0.0] * 6]),
        arm_bulges=np.full((2, 3), 0.29),
        max_stretch=1.5,
        nodes=nodes,
        level_set=BundleLevelSet(np.array([-0.5, 0.0, 0.25]), 0.5, np.linspace(-0.05, 1.2, 60).reshape(4, 3, 5), 1.0),
    )
    facts: dict[str, Any] = {"title": "block", "licence": "CC0-1.0", "up": [0.0, 0.0, 1.0], "metres_per_unit": 1.0}
    return Bundle((BundleBody("block", cloud, cage), BundleBody("scene", cloud)), 60.0, FRAMES, facts)


@cache
def bundle_bytes() -> bytes:
    """Return the bytes of the file of ``small_bundle``."""
    with tempfile.TemporaryDirectory() as folder:
        write_bundle(Path(folder) / "a.egs", small_bundle())
        return (Path(folder) / "a.egs").read_bytes()


def text_of(data: bytes) -> dict[str, Any]:
    """Return the parsed JSON text of a bundle file."""
    return json.loads(data[HEAD.size : HEAD.size + HEAD.unpack_from(data)[2]])


def with_text(text: bytes) -> bytes:
    """Return the bytes of the file of ``small_bundle`` with the JSON text replaced by ``text``."""
    data = bundle_bytes()
    magic, version, length = HEAD.unpack_from(data)
    return HEAD.pack(magic, version, len(text)) + text + data[HEAD.size + length :]
