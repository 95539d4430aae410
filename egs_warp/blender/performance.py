"""Runs and bundles, read with NumPy alone."""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .read_bundle import Bundle  # pyright: ignore[reportMissingImports]

TRAJECTORY, CREATURE = "trajectory.npz", "creature.npz"
FRAME_RATE = 60.0
"""Frames per second of a run, as in its film."""
BAND_0 = 0.28209479177387814
"""Value of the spherical harmonic of band 0."""
_READ_ERRORS = (
    *(OSError, ValueError, KeyError, IndexError, TypeError, AssertionError, EOFError, MemoryError),
    *(zipfile.BadZipFile, zlib.error, np.linalg.LinAlgError),
)


class ReadError(Exception):
    """Error for a file that cannot be read; the message is one line for the user."""


class _RunSplats(Bundle):
    """Splats of a run, with the arrays of a bundle but without node positions over time."""

    def __init__(self, arrays: dict[str, np.ndarray], max_stretch: float) -> None:
        self.arrays, self.body = arrays, {"max_stretch": max_stretch}
        self._prepare(arrays)


@dataclass(frozen=True)
class Muscles:
    """Muscles of a run: P end points, M segments, F fibres, N nodes, S solver steps."""

    ends: np.ndarray
    """(P, N) weights that give the end points from the positions of the nodes."""
    segments: np.ndarray
    """(M, 2) int32, indices of the end points of each segment."""
    activations: np.ndarray
    """(S, M), -1 to 1, activation of each segment divided by its bound."""
    fibre_from_segment: np.ndarray
    """(M,) int32, fibre of each segment."""
    names: tuple[str, ...]
    """(F,) names of the fibres."""
    strengths: np.ndarray
    """(F,) maximum force of a segment of each fibre, body weights."""
    rest_nodes: np.ndarray
    """(N, 3) nodes at rest, m."""
    capture_axes: np.ndarray
    """(3, 3) rows are the axes of the body's frame in the capture."""
    capture_origin: np.ndarray
    """(3,) origin of the body's frame in the capture, units of the capture."""
    metres_per_unit: float
    """Number of metres in one unit of the capture."""

    def in_capture(self, points: np.ndarray) -> np.ndarray:
        """Transform ``points`` (n, 3), m, to the frame and units of the capture."""
        return self.capture_origin + (points / self.metres_per_unit) @ self.capture_axes


@dataclass(frozen=True)
class Contacts:
    """Contacts in all solver steps of a run; C is the number of contacts."""

    step: np.ndarray
    """(C,) int32, solver step of each contact; step i leads from state i to state i + 1."""
    nodes: np.ndarray
    """(C, 4) int32, cage nodes whose combination is the contact point."""
    weights: np.ndarray
    """(C, 4) weights of these nodes."""
    force: np.ndarray
    """(C, 3) force on the body, body weights."""


@dataclass(frozen=True)
class FilmCamera:
    """Camera of the film of a run; lengths in pixels and metres."""

    rotation: np.ndarray
    """(3, 3) rotation from the frame of the body to the camera's axes: x right, y down, z forward."""
    centre: np.ndarray
    """(3,) position, m, frame of the body."""
    focal_length: float
    principal_point: tuple[float, float]
    size: tuple[int, int]
    """Width and height, pixels."""


@dataclass(frozen=True)
class Performance:
    """Splats, cage and motion of one creature, in metres. The z axis points up, and the ground under the body at rest
    is z = 0."""

    name: str
    """Name of the file, or of the folder of the run."""
    bundle: Bundle
    """Splats at rest, and the data by which the cage deforms them."""
    opacity_logits: np.ndarray
    """(n,) logits of the opacities of the splats."""
    band_0: np.ndarray
    """(n, 3) SH coefficients of band 0."""
    track: np.ndarray
    """(F, N, 3) positions of the nodes in each frame, m."""
    fps: float
    """Frames per second."""
    steps: np.ndarray
    """(F,) solver step of each frame; empty in a bundle."""
    node_mass: np.ndarray
    """(N,) mass of each node, kg; empty in a bundle."""
    height: float
    """Height of the body, m."""
    muscles: Muscles | None
    """Muscles of the run; None in a bundle."""
    contacts: Contacts | None
    """Contacts of the run; None in a bundle."""
    camera: FilmCamera | None
    """Camera of the film; None in a bundle."""

    @property
    def frame_count(self) -> int:
        """Number of frames F."""
        return len(self.track)

    def clamped(self, index: float) -> float:
        """Return the fractional frame ``index`` clamped to the range from the first to the last frame."""
        return min(max(index, 0.0), self.frame_count - 1.0)

    def nodes(self, index: float) -> np.ndarray:
        """Return the positions (N, 3) of the nodes at the fractional frame ``index``, m, interpolated linearly."""
        before, after = self.track[int(index)], self.track[int(np.ceil(index))]
        return before + (index % 1) * (after - before)

    def splats(self, index: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return means (n, 3), covariances (n, 3, 3) and rotations (n, 3, 3) of the splats at the fractional frame
        ``index``."""
        # Make this the only frame of the bundle's track, because the reader deforms splats to frames of its own track.
        self.bundle.nodes = self.nodes(index)[None]
        return self.bundle.frame(0)

    def activations(self, index: float) -> np.ndarray:
        """Return the activations (M,) of the step that leads to the nearest frame."""
        muscles, step = self.muscles, int(self.steps[round(index)])
        assert muscles is not None
        return muscles.activations[step - 1] if step > 0 else np.zeros(len(muscles.segments))

    def forces(self, index: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the contact points, in m, and the forces on the body, in body weights, both (C, 3), in the step that
        leads to the nearest frame."""
        contacts = self.contacts
        assert contacts is not None
        chosen = np.flatnonzero(contacts.step == int(self.steps[round(index)]) - 1)
        points = np.einsum("cw,cwi->ci", contacts.weights[chosen], self.nodes(index)[contacts.nodes[chosen]])
        return points, contacts.force[chosen]

    def centre_of_mass(self, index: float) -> np.ndarray:
        """Return the centre of mass (3,), m."""
        return self.node_mass @ self.nodes(index) / self.node_mass.sum()


def read_performance(path: Path) -> Performance:
    """Read the first body of a bundle, or a run. ``path`` is the bundle, the folder of the run, or one of the two files
    of arrays of the run.

    Raises:
        ReadError: the files are missing or do not belong to a run or a bundle.
    """
    if path.is_dir() or path.name in (TRAJECTORY, CREATURE):
        return _read_run(path if path.is_dir() else path.parent)
    try:
        bundle = Bundle(str(path))
        opacities, none = np.clip(bundle.arrays["opacities"], 1e-3, 1.0 - 1e-3), np.zeros(0)
        return Performance(
            name=path.stem,
            bundle=bundle,
            opacity_logits=np.log(opacities / (1.0 - opacities)),
            band_0=(bundle.arrays["colours"] - 0.5) / BAND_0,
            track=bundle.nodes,
            fps=float(bundle.text["rate"]),
            steps=none,
            node_mass=none,
            height=float(bundle.text["height"]),
            muscles=None,
            contacts=None,
            camera=None,
        )
    except _READ_ERRORS as error:
        advice = f"choose a bundle of egs-warp export, or {TRAJECTORY} in the folder of a run"
        raise ReadError(f"{path}: cannot be read ({_reason(error)}); {advice}") from error


def _read_run(folder: Path) -> Performance:
    run, creature = _arrays(folder / TRAJECTORY), _arrays(folder / CREATURE)
    if "carriers" not in creature:
        advice = "write a bundle of the run with egs-warp export, and import that"
        raise ReadError(f"{folder / CREATURE}: was written by an earlier version; {advice}")
    try:
        time = run["time"]
        frames = np.arange(round(FRAME_RATE * (time[-1] - time[0])) + 1) / FRAME_RATE + time[0]
        steps = np.searchsorted(0.5 * (time[1:] + time[:-1]), frames)
        weight = float(run["node_mass"].sum() * np.linalg.norm(run["gravity"]))
        splats = creature | {"rotations": _rotation_vectors(creature["rotations"])}
        splats |= {"rest_nodes": run["rest_positions"], "cage_tets": run["tets"]}
        # In a bundle, the indices of the tetrahedra of arms are relative to the index of the mean's tetrahedron.
        splats["arm_tets"] = creature["arm_tets"] - creature["tets"][creature["carriers"] == 1, None]
        return Performance(
            name=folder.resolve().name,
            bundle=_RunSplats(splats, float(creature["max_stretch"])),
            opacity_logits=creature["opacity_logits"],
            band_0=creature["sh"][:, 0],
            track=run["positions"][steps],
            fps=FRAME_RATE,
            steps=steps,
            node_mass=run["node_mass"],
            height=float(run["height"]),
            muscles=_muscles(run, creature, weight),
            contacts=Contacts(
                run["contact_step"], run["contact_nodes"], run["contact_weights"], run["contact_force"] / weight
            ),
            camera=_camera(creature),
        )
    except _READ_ERRORS as error:
        raise ReadError(
            f"{folder}: the files are not of the same run ({_reason(error)}); run egs-warp animate again"
        ) from error


def _rotation_vectors(quaternions: np.ndarray) -> np.ndarray:
    """Return the rotation vectors (n, 3), axis times angle in rad, of unit quaternions (n, 4), w, x, y, z."""
    w, xyz = np.split(quaternions.astype(float), [1], axis=1)
    sines = np.linalg.norm(xyz, axis=1, keepdims=True)
    return xyz * (2.0 * np.arctan2(sines, w) / np.maximum(sines, 1e-300))


def _muscles(run: dict[str, np.ndarray], creature: dict[str, np.ndarray], weight: float) -> Muscles:
    starts = creature["muscle_end_starts"]
    ends = np.zeros((len(starts) - 1, len(run["rest_positions"])))
    rows = np.repeat(np.arange(len(ends)), np.diff(starts))
    ends[rows, creature["muscle_end_nodes"]] = creature["muscle_end_weights"]
    bounds, names = creature["muscle_bounds"], creature["fibre_names"].tolist()
    fibres, forces = creature["fibre_from_segment"], run["muscle_stiffness"] * bounds / weight
    return Muscles(
        ends=ends,
        segments=creature["muscle_segments"],
        activations=run["activations"] / np.maximum(bounds, 1e-12),
        fibre_from_segment=fibres,
        names=tuple(names),
        strengths=np.array([forces[fibres == fibre].mean() for fibre in range(len(names))]),
        rest_nodes=run["rest_positions"],
        capture_axes=run["body_axes"],
        capture_origin=run["body_origin"],
        metres_per_unit=float(run["metres_per_unit"]),
    )


def _camera(creature: dict[str, np.ndarray]) -> FilmCamera:
    rotation = creature["camera_rotation"]
    focal_length, x, y = (float(creature[f"camera_{name}"]) for name in ("fx", "cx", "cy"))
    size = int(creature["camera_width"]), int(creature["camera_height"])
    return FilmCamera(rotation, -rotation.T @ creature["camera_translation"], focal_length, (x, y), size)


def _arrays(path: Path) -> dict[str, np.ndarray]:
    try:
        # np.load(path) would leave the file open if it is a broken archive.
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as data:
            return dict(data)
    except FileNotFoundError as error:
        raise ReadError(f"{path}: is missing; choose the folder of a finished run of egs-warp animate") from error
    except _READ_ERRORS as error:
        raise ReadError(f"{path}: cannot be read ({_reason(error)}); run egs-warp animate again") from error


def _reason(error: Exception) -> str:
    return f"no array {error}" if isinstance(error, KeyError) else str(error).splitlines()[0] if str(error) else "empty"
