"""Bundles: splats at rest, their cages, and the motion of the cages, in one file (docs/concepts/bundle.md)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.io.atomic import atomic_write
from egs_warp.io.bundle_arrays import PackedArray, indices, quantised
from egs_warp.io.bundle_file import BYTE_ZERO, HEAD, MAGIC, VERSION, Carrier, read_valid_file
from egs_warp.io.bundle_track import NodeTrack, TrackPredictor, whole_steps
from egs_warp.io.raw import logits_from_opacities
from egs_warp.version import __version__

BLOCK_FRAMES = 60
"""Number of frames in a block. A player can start when it has received the first block of each body."""
_BAND_STEP = 1.0 / 64.0
"""Quantisation step of SH coefficients above band 0; it is larger if the largest coefficient exceeds 127 of these
steps. With finer steps, incompressible noise would take half of the file."""
_ROTATION_STEP, _SCALE_STEP, _COLOUR_STEP, _ARM_STEP = 1.0 / 512.0, 1.0 / 128.0, 1.0 / 512.0, 1.0 / 4096.0
"""Quantisation steps of rotation vectors (rad), log scales, colours, and bulges and lengths of arms (standard
deviations)."""
_NORMAL_STEP = 1.0 / 127.0
"""Quantisation step of normals."""
_MAX_DEPTH = 0.1
"""Depth in a body at which the coefficients of its level set are clipped, in body heights."""


@dataclass(frozen=True)
class BundleLevelSet:
    """Level set of a body at rest, negative inside: a triquadratic B-spline over a cubic lattice. Players compute from
    it the contact shadows of the body on other bodies."""

    origin: np.ndarray
    """(3,) position of lattice node (0, 0, 0)."""
    spacing: float
    """Distance between lattice nodes."""
    coefficients: np.ndarray
    """(nx, ny, nz) coefficients of the spline."""
    height: float
    """Height of the body."""


@dataclass(frozen=True)
class BundleCage:
    """Cage of a body, the embedding of its Gaussians, and its motion.

    In the shapes below, n is the number of Gaussians, and r is the number of Gaussians with the carrier ``ARMS``.
    """

    rest_nodes: np.ndarray
    """(N, 3) float32, rest positions."""
    cage_tets: np.ndarray
    """(T, 4) node indices of each tetrahedron."""
    surface: np.ndarray
    """(B, 3) node indices of the surface triangles, wound outwards."""
    tets: np.ndarray
    """(n,) index of the tetrahedron that contains each mean."""
    carriers: np.ndarray
    """(n,) uint8, ``Carrier`` of each Gaussian."""
    arm_tets: np.ndarray
    """(r, 6) indices of the tetrahedra that contain the ends of the three axes: the positive, then the negative
    ends."""
    arm_shares: np.ndarray
    """(r, 6) fraction of each semi-axis inside the tetrahedron of the mean; used where ``arm_lengths`` is 0."""
    arm_lengths: np.ndarray
    """(r, 6) lengths of the semi-axes whose ends are beyond the neighbours of the mean's tetrahedron, in standard
    deviations along the axis; 0 for other semi-axes."""
    arm_bulges: np.ndarray
    """(r, 3) shifts of the mean due to the difference of two opposite semi-axes, in standard deviations along them."""
    max_stretch: float
    """Maximum stretch of a semi-axis relative to the stretch of the material at its two ends."""
    nodes: np.ndarray
    """(F, N, 3) positions of the nodes in each frame."""
    level_set: BundleLevelSet | None = None
    """Level set of the body at rest; None if it casts no shadows on other bodies."""


@dataclass(frozen=True)
class BundleBody:
    """Splats that move with a cage, or static splats."""

    name: str
    splats: GaussianCloud
    """The n Gaussians at rest, after splitting."""
    cage: BundleCage | None = None
    """Cage of the splats; None for static splats, such as the rest of a scene."""
    normals: np.ndarray | None = None
    """(n, 3) unit normals of the surface at rest, zero where there is no surface; None if the body is not relit."""


@dataclass(frozen=True)
class Bundle:
    """Content of a bundle."""

    bodies: tuple[BundleBody, ...]
    rate: float
    """Frames per second."""
    frames: int
    """Number of frames of every cage."""
    facts: Mapping[str, Any]
    """Other properties of the JSON text of a bundle: ``title``, ``licence``, ``up``, ``metres_per_unit``, ``height``,
    ``front``, ``flat_ground``, ``camera``, ``capture``, ``light``."""


def write_bundle(path: Path, bundle: Bundle) -> None:
    """Write a bundle to ``path``. Raises ``UserError`` if the file cannot be written."""
    with atomic_write(path) as temporary:
        temporary.write_bytes(bundle_file(bundle))


def bundle_file(bundle: Bundle) -> bytes:
    """Return the content of a bundle's file as bytes."""
    pieces: list[bytes] = []
    start = 0

    def stored(arrays: Mapping[str, PackedArray]) -> dict[str, Any]:
        nonlocal start
        entries = {}
        for name, array in arrays.items():
            pieces.append(array.data())
            entries[name] = array.entry(start, len(pieces[-1]))
            start += len(pieces[-1])
        return entries

    bodies: list[dict[str, Any]] = []
    moving: list[tuple[dict[str, Any], NodeTrack]] = []
    for body in bundle.bodies:
        cage = body.cage
        facts: dict[str, Any] = {"name": body.name, "count": body.splats.count, "degree": body.splats.sh_degree}
        facts |= {"antialiased": body.splats.antialiased}
        arrays = _splat_arrays(body.splats)
        if cage is not None:
            track = NodeTrack.fitted(cage.rest_nodes, cage.nodes)
            moving.append((facts, track))
            facts |= {"max_stretch": cage.max_stretch, "node_step": track.step, "node_error": track.error}
            arrays = {**_cage_arrays(cage), **track.predictor.arrays(), **arrays}
            if cage.level_set is not None:
                facts["level_set"], arrays["level_set"] = _packed_level_set(cage.level_set)
        if body.normals is not None:
            arrays["normals"] = quantised(body.normals, np.uint8, step=_NORMAL_STEP, lower=-BYTE_ZERO * _NORMAL_STEP)
        facts |= {"arrays": stored(arrays)} | ({} if cage is None else {"blocks": []})
        bodies.append(facts)
    # Blocks of all bodies for the same time are adjacent in the file, so that all bodies can move as soon as possible.
    for first in range(0, bundle.frames, BLOCK_FRAMES):
        for facts, track in moving:
            displacements = track.displacements[first : first + BLOCK_FRAMES]
            arrays = stored({"residuals": track.predictor.residuals(displacements)})
            facts["blocks"].append({"first": first, "frames": len(displacements), "arrays": arrays})
    text = json.dumps(
        {
            "format": "egs-bundle",
            "version": VERSION,
            "generator": f"egs_warp {__version__}",
            **bundle.facts,
            "rate": bundle.rate,
            "frames": bundle.frames,
            "bytes": start,
            "bodies": bodies,
        },
        separators=(",", ":"),
    ).encode()
    return b"".join([HEAD.pack(MAGIC, VERSION, len(text)), text, *pieces])


def read_bundle(path: Path) -> Bundle:
    """Read a bundle. Raises ``UserError`` for the first of its ``findings``."""
    file = read_valid_file(path)
    facts = {name: value for name, value in file.text.items() if name not in _OWN_PROPERTIES}
    bodies = []
    for body, arrays, blocks in zip(file.text["bodies"], file.arrays, file.blocks, strict=True):
        numbers = {name: array.numbers for name, array in arrays.items()}
        cage = None
        if "blocks" in body:
            predictor, step = TrackPredictor.from_arrays(arrays), body["node_step"]
            displacements = np.concatenate([predictor.displacements(block["residuals"]) for block in blocks])
            tets = numbers["tets"].astype(np.int32)
            carriers = arrays["carriers"].stored
            arms = arrays["arm_tets"].stored
            level_set = None
            if "level_set" in body:
                own = body["level_set"]
                coefficients = numbers["level_set"].reshape(own["counts"])
                level_set = BundleLevelSet(np.array(own["origin"]), own["spacing"], coefficients, own["height"])
            cage = BundleCage(
                rest_nodes=numbers["rest_nodes"],
                cage_tets=numbers["cage_tets"].astype(np.int32),
                surface=numbers["surface"].astype(np.int32),
                tets=tets,
                carriers=carriers,
                arm_tets=(arms + tets[carriers == Carrier.ARMS, None].astype(arms.dtype)).astype(np.int32),
                arm_shares=numbers["arm_shares"],
                arm_lengths=numbers["arm_lengths"],
                arm_bulges=numbers["arm_bulges"],
                max_stretch=body["max_stretch"],
                nodes=step * (whole_steps(numbers["rest_nodes"], step) + np.cumsum(displacements, axis=0)),
                level_set=level_set,
            )
        normals = numbers.get("normals")
        bodies.append(BundleBody(body["name"], _cloud(numbers, body["antialiased"]), cage, normals))
    return Bundle(tuple(bodies), file.text["rate"], file.text["frames"], facts)


_OWN_PROPERTIES = ("format", "version", "rate", "frames", "bytes", "bodies")
"""Properties of the JSON text that are not in ``Bundle.facts``."""


def _splat_arrays(cloud: GaussianCloud) -> dict[str, PackedArray]:
    sh = cloud.sh.numpy().astype(np.float64)
    arrays = {
        "means": quantised(cloud.means.numpy(), np.uint16),
        "rotations": quantised(_rotation_vectors(cloud.rotations.numpy()), np.uint16, step=_ROTATION_STEP),
        "log_scales": quantised(cloud.log_scales.numpy(), np.uint16, step=_SCALE_STEP),
        "opacities": quantised(cloud.opacities(), np.uint8, step=1.0 / 255.0, lower=0.0),
        "colours": quantised(0.5 + SH_BAND_0 * sh[:, 0], np.uint16, step=_COLOUR_STEP),
    }
    if cloud.sh_degree > 0:
        bands = sh[:, 1:].transpose(0, 2, 1)
        step = np.maximum(np.abs(bands).max(axis=(0, 1)) / (BYTE_ZERO - 1), _BAND_STEP)
        arrays["bands"] = quantised(bands, np.uint8, step=step, lower=-BYTE_ZERO * step)
    return arrays


def _cloud(numbers: Mapping[str, np.ndarray], antialiased: bool) -> GaussianCloud:
    band_0 = (numbers["colours"] - 0.5) / SH_BAND_0
    bands = numbers.get("bands", np.zeros((len(band_0), 3, 0))).transpose(0, 2, 1)
    return GaussianCloud.from_numpy(
        numbers["means"],
        _quaternions(numbers["rotations"]),
        numbers["log_scales"],
        logits_from_opacities(numbers["opacities"]),
        np.concatenate([band_0[:, None], bands], axis=1),
        antialiased=antialiased,
    )


def _rotation_vectors(quaternions: np.ndarray) -> np.ndarray:
    """Return the rotation vectors (n, 3), rad, of length at most pi, of unit quaternions (n, 4) w, x, y, z."""
    q = quaternions.astype(np.float64)
    q = np.where(q[:, :1] < 0.0, -q, q)
    sines = np.linalg.norm(q[:, 1:], axis=1)
    angles = 2.0 * np.arctan2(sines, q[:, 0])
    return q[:, 1:] * np.where(sines > 0.0, angles / np.maximum(sines, 1e-300), 2.0)[:, None]


def _quaternions(vectors: np.ndarray) -> np.ndarray:
    """Return the unit quaternions (n, 4) w, x, y, z of rotation ``vectors`` (n, 3), rad."""
    halves = 0.5 * np.linalg.norm(vectors, axis=1, keepdims=True)
    # np.sinc(x) is sin(pi x) / (pi x).
    return np.concatenate([np.cos(halves), 0.5 * vectors * np.sinc(halves / np.pi)], axis=1)


def _packed_level_set(level_set: BundleLevelSet) -> tuple[dict[str, Any], PackedArray]:
    """Return the JSON object of the lattice of a level set, and its coefficients."""
    facts = {
        "origin": level_set.origin.tolist(),
        "spacing": level_set.spacing,
        "counts": list(level_set.coefficients.shape),
        "height": level_set.height,
    }
    deep = -_MAX_DEPTH * level_set.height
    return facts, quantised(np.maximum(level_set.coefficients, deep).ravel(), np.uint8, lower=deep)


def _cage_arrays(cage: BundleCage) -> dict[str, PackedArray]:
    rows = cage.carriers == Carrier.ARMS
    tets = indices(cage.tets)
    # Most ends are in or near the tetrahedron of the mean, so the differences of the indices are small and compress
    # well.
    ends = cage.arm_tets.astype(tets.stored.dtype) - tets.stored[rows, None]
    return {
        "rest_nodes": PackedArray(cage.rest_nodes.astype(np.float32)),
        "cage_tets": indices(cage.cage_tets),
        "surface": indices(cage.surface),
        "tets": tets,
        "carriers": PackedArray(cage.carriers.astype(np.uint8)),
        "arm_tets": PackedArray(ends),
        "arm_shares": quantised(cage.arm_shares, np.uint8, step=1.0 / 255.0, lower=0.0),
        "arm_lengths": quantised(cage.arm_lengths, np.uint16, step=_ARM_STEP, lower=0.0),
        "arm_bulges": quantised(cage.arm_bulges, np.uint16, step=_ARM_STEP, lower=0.0),
    }
