"""Procedural rooms with a known object, as captures with labelled Gaussians: toys on duvets, floors, grass, furniture.

A room is built directly as a capture: surfaces are sampled, and each sample becomes a flat Gaussian. Like a trained
capture, it has large Gaussians on plain surfaces, Gaussians with mixed colours that bridge the object and its
surroundings, haze in the air, hardly any Gaussians that no photo shows, and an arbitrary frame. The photos are taken by
hand from the accessible side. Equal arguments give equal bits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import room_solids as solids
from annotated_scenes import DrawnScene, DrawnView
from egs_warp.assets.object import KEY_LIGHT
from egs_warp.assets.surface import SurfaceSamples, flat_gaussians
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import ARRAYS, SH_BAND_0, GaussianCloud
from egs_warp.render import render_gaussians
from egs_warp.segmentation.selection_masks import masks_from_selection
from egs_warp.segmentation.votes import MaskedView, blending_votes
from room_solids import SceneLight

Relief = Callable[[np.ndarray], np.ndarray]
"""Function that returns the heights (n,) of the ground at points (n, 2)."""

VIEWS = 8
"""Number of annotated photos."""
_PHOTOS = 16
"""Number of photos without annotations."""
_SIDES = (320, 240)
"""Sides of a photo in pixels."""
_BRIDGE = 0.07
"""Maximum distance from the surroundings, in heights of the object, of Gaussians that bridge the object and its
surroundings."""
_UNSEEN_SHARE = 0.1
"""Fraction of the Gaussians without blending weight in the photos that is retained."""
_HAZE_SHARE = 0.01


@dataclass(frozen=True)
class SceneLayout:
    """Toy, support and neighbours in a room."""

    toy: str
    """Name in ``TOYS``."""
    support: str
    """``duvet``, ``floor``, ``carpet``, ``grass``, ``table``, ``chair``, ``sofa`` or ``shelf``."""
    neighbours: tuple[str, ...] = ()
    """``wall``, ``wardrobe``, ``toys``, ``pillow``, or ``table`` for a table that covers half of the toy."""
    turned: float = 0.0
    """Rotation of the toy about the vertical axis, degrees."""


SCENES: Mapping[str, SceneLayout] = {
    "bear_duvet_wall_wardrobe": SceneLayout("bear", "duvet", ("wall", "wardrobe")),
    "rabbit_duvet_pillow": SceneLayout("rabbit", "duvet", ("pillow",), 30.0),
    "dog_duvet_toys": SceneLayout("dog", "duvet", ("toys",), -40.0),
    "duck_duvet_wall": SceneLayout("duck", "duvet", ("wall",), 60.0),
    "robot_floor_wall": SceneLayout("robot", "floor", ("wall",), 10.0),
    "bear_floor_wardrobe": SceneLayout("bear", "floor", ("wardrobe",), 20.0),
    "dog_carpet_toys": SceneLayout("dog", "carpet", ("toys",), 70.0),
    "blocks_floor_table": SceneLayout("blocks", "floor", ("table",), 25.0),
    "bear_floor_table": SceneLayout("bear", "floor", ("table",), -15.0),
    "rabbit_grass": SceneLayout("rabbit", "grass", (), 15.0),
    "duck_grass": SceneLayout("duck", "grass", (), -70.0),
    "dog_grass_toys": SceneLayout("dog", "grass", ("toys",), 120.0),
    "bear_chair": SceneLayout("bear", "chair"),
    "robot_chair": SceneLayout("robot", "chair", (), 20.0),
    "rabbit_chair_wall": SceneLayout("rabbit", "chair", ("wall",), 80.0),
    "duck_table": SceneLayout("duck", "table", (), 45.0),
    "blocks_table_toys": SceneLayout("blocks", "table", ("toys",), -20.0),
    "robot_carpet_wall_wardrobe": SceneLayout("robot", "carpet", ("wall", "wardrobe"), -10.0),
    "bear_sofa": SceneLayout("bear", "sofa"),
    "dog_shelf": SceneLayout("dog", "shelf", (), 75.0),
}
"""Layouts of the rooms by name."""

_FLOOR = {"table": -2.0, "chair": -1.6, "sofa": -1.0, "shelf": -1.6}
"""Height of the floor below an object that stands on furniture."""


@dataclass(frozen=True)
class SyntheticScene:
    """A capture of a room, with its ground truth."""

    name: str
    cloud: GaussianCloud
    is_object: np.ndarray
    """(n,) bool, the object's Gaussians."""
    cameras: tuple[Camera, ...]
    """Cameras of the photos."""
    drawn: DrawnScene
    """Annotated views, which are not among ``cameras``."""
    solids: tuple[list[solids.Solid], list[solids.Solid]]
    """Solids of the object and of everything else, in the room's axes: z up, the object at the origin."""
    relief: Relief
    """Ground under the object, in the room's axes."""
    frame: BodyFrame
    """Frame of the room in the capture."""

    def photos(self) -> list[np.ndarray]:
        """Render the photo (H, W, 3) float32 of each camera."""
        return [np.clip(render_gaussians(self.cloud, one).colour.numpy(), 0.0, 1.0) for one in self.cameras]


def build_scene(
    name: str,
    *,
    seed: int = 0,
    density: float = 1.0,
    light: SceneLight | None = None,
    device: str | None = None,
) -> SyntheticScene:
    """Build the room ``name`` of ``SCENES``.

    Args:
        name: name of the room.
        seed: seed of all random properties: folds, textures, defects, cameras, frame.
        density: factor of the number of Gaussians.
        light: light that shades all surfaces and casts shadows; None for a fixed light without shadows.
        device: Warp device.
    """
    layout, random = SCENES[name], np.random.default_rng([seed, list(SCENES).index(name)])
    relief = _relief(layout.support, random)
    groups = _solid_groups(layout, relief)
    parts = [_of_solids(groups, number, relief, density, random, light) for number in range(len(groups))]
    if relief is not None:
        parts.append(_of_ground(layout.support, relief, groups, density, random, light))
    if layout.support in _FLOOR:
        level = _FLOOR[layout.support]
        parts.append(_of_ground("floor", lambda points: np.full(len(points), level), groups, density, random, light))
    fields = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    is_object = np.repeat([number == 0 for number in range(len(parts))], [len(part["means"]) for part in parts])
    _bridge(fields, is_object, random)
    if layout.support == "grass":
        assert relief is not None
        fields, is_object = _added(fields, is_object, _blades(relief, groups, density, random))
    haze = _haze(fields, random)
    fields, is_object = _added(fields, is_object, haze)
    cameras = [_camera(layout, random) for _ in range(_PHOTOS + VIEWS)]
    cloud = GaussianCloud.from_numpy(*(fields[name] for name in ARRAYS), device=device)
    whole = [MaskedView(one, np.ones((one.height, one.width), bool), "photo") for one in cameras]
    kept = blending_votes(cloud, whole).inside > 0.0
    kept |= random.uniform(size=len(kept)) < _UNSEEN_SHARE
    cloud, cameras, frame = _in_any_frame(cloud.subset(kept), cameras, random)
    is_object = is_object[kept]
    chosen = np.linspace(0, len(cameras) - 1, VIEWS).round().astype(int)
    drawn = DrawnScene(name, None, None, tuple(_annotated(cloud, is_object, cameras[k]) for k in chosen))
    photos = tuple(camera for k, camera in enumerate(cameras) if k not in chosen)
    others = [one for group in groups[1:] for one in group.solids]
    ground = relief if relief is not None else lambda points: np.zeros(len(points))
    return SyntheticScene(name, cloud, is_object, photos, drawn, (groups[0].solids, others), ground, frame)


def _annotated(cloud: GaussianCloud, is_object: np.ndarray, camera: Camera) -> DrawnView:
    (visible,) = masks_from_selection(cloud, is_object, [camera])
    alone = render_gaussians(cloud.subset(is_object), camera).alpha.numpy() > 0.5
    return DrawnView(camera, visible.mask, np.zeros((0, 2)), alone & ~visible.mask)


@dataclass(frozen=True)
class _SolidGroup:
    """Group of solids whose Gaussians have the same spacing."""

    solids: list[solids.Solid]
    spacing: float


def _solid_groups(layout: SceneLayout, relief: Relief | None) -> list[_SolidGroup]:
    """Return the groups of a room; the first one is the object."""
    toy = [one.moved((0, 0, 0), layout.turned) for one in solids.TOYS[layout.toy]()]
    rear = max(_reach(one, 1) for one in toy)
    groups = [_SolidGroup(toy, 0.022)]

    def level(x: float, y: float) -> float:
        around = np.array([x, y]) + 0.25 * np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2)
        return 0.0 if relief is None else float(relief(around).mean())

    floor = _FLOOR.get(layout.support, -1.5 if layout.support == "duvet" else 0.0)
    make = {"table": lambda: solids.table(0.0), "chair": solids.chair, "sofa": solids.sofa, "shelf": solids.shelf}
    if layout.support in make:
        groups.append(_SolidGroup(make[layout.support](), 0.05))
    for name in layout.neighbours:
        if name == "wall":
            at = rear if layout.support != "chair" else 0.62
            groups.append(_SolidGroup([solids.box((-4, at, floor), (4, at + 0.1, 4.5), (0.45, 0.50, 0.47))], 0.13))
        elif name == "wardrobe":
            side = min(one.centre[0] for one in toy) - 0.3
            groups.append(_SolidGroup(solids.wardrobe(side, floor), 0.08))
        elif name == "table":
            over = [one.moved((0.5, 1.3, 0.0)) for one in solids.table(1.3)]
            groups.append(_SolidGroup(over, 0.05))
        elif name == "pillow":
            groups.append(_SolidGroup(solids.pillow((0.1, 0.75, level(0.1, 0.75))), 0.035))
        else:
            for toy_name, x, y in (("duck", -0.72, 0.12), ("blocks", 0.66, 0.3), ("rabbit", 0.1, 0.95)):
                other = [one.moved((x, y, level(x, y)), 50.0 * x, 0.8) for one in solids.TOYS[toy_name]()]
                groups.append(_SolidGroup(other, 0.03))
    return groups


def _reach(one: solids.Solid, axis: int) -> float:
    """Return the largest coordinate of the surface of a solid along ``axis``."""
    arms = one.turn[axis] * one.half
    return float(one.centre[axis] + (np.abs(arms).sum() if one.is_box else np.linalg.norm(arms)))


def _relief(support: str, random: np.random.Generator) -> Relief | None:
    """Return the ground under the object; None if the object stands on furniture.

    A toy sinks into soft ground: the mean height of the ground under it is 0.04 on a duvet and 0.02 on grass.
    """
    if support in ("floor", "carpet"):
        return lambda points: np.zeros(len(points))
    if support not in ("duvet", "grass"):
        return None
    count, amplitude, sunk = (26, 0.16, 0.04) if support == "duvet" else (40, 0.06, 0.02)
    angles, shifts, phases = (
        random.uniform(0.0, np.pi, count),
        random.uniform(-2.5, 2.5, (2, count)),
        random.uniform(0.0, 6.0, count),
    )
    heights, widths = amplitude * random.uniform(0.3, 1.0, count), random.uniform(0.07, 0.22, count)

    def folds(points: np.ndarray) -> np.ndarray:
        total = np.zeros(len(points))
        for angle, across, along, phase, height, width in zip(angles, *shifts, phases, heights, widths, strict=True):
            u = points @ [np.cos(angle), np.sin(angle)] - along
            v = points @ [-np.sin(angle), np.cos(angle)] - across + 0.12 * np.sin(3.0 * u + phase)
            total += height * np.exp(-((v / width) ** 2) - (u / 1.1) ** 2)
        return total

    under = folds(0.3 * random.uniform(-1.0, 1.0, (200, 2))).mean()
    return lambda points: folds(points) - under + sunk


def _of_solids(
    groups: list[_SolidGroup],
    number: int,
    relief: Relief | None,
    density: float,
    random: np.random.Generator,
    light: SceneLight | None,
) -> dict[str, np.ndarray]:
    """Return the Gaussians of the surface of one group that is outside all other solids and above the ground."""
    parts = []
    own = groups[number]
    spacing = own.spacing / np.sqrt(density)
    for one in own.solids:
        samples = one.samples(spacing, random)
        visible = np.ones(len(samples.points), bool)
        for other in (other for group in groups for other in group.solids if other is not one):
            visible &= ~other.contains(samples.points)
        if relief is not None:
            visible &= samples.points[:, 2] > relief(samples.points[:, :2])
        if visible.any():
            samples = SurfaceSamples(samples.points[visible], samples.normals[visible], spacing)
            lit = _lit(samples, groups, light)
            parts.append(_painted(samples, np.array(one.colour), lit, random, plain=own.spacing > 0.07))
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def _of_ground(
    kind: str,
    relief: Relief,
    groups: list[_SolidGroup],
    density: float,
    random: np.random.Generator,
    light: SceneLight | None,
) -> dict[str, np.ndarray]:
    """Return the Gaussians of the ground outside all solids; it is darker next to the object."""
    spacing, reach, colour = {
        "duvet": (0.042, 2.6, (0.30, 0.38, 0.55)),
        "grass": (0.05, 2.8, (0.10, 0.12, 0.04)),
        "carpet": (0.06, 3.2, (0.35, 0.14, 0.11)),
        "floor": (0.08, 4.0, (0.40, 0.25, 0.13)),
    }[kind]
    spacing /= np.sqrt(density)
    flat = solids.jittered_grid(np.full(2, reach), spacing, random)
    points = np.column_stack([flat, relief(flat)])
    step = 1e-3
    slopes = [(relief(flat + e) - relief(flat - e)) / (2.0 * step) for e in step * np.eye(2)]
    normals = np.column_stack([-slopes[0], -slopes[1], np.ones(len(flat))])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    outside = ~np.any([one.contains(points) for group in groups for one in group.solids], axis=0)
    samples = SurfaceSamples(points[outside], normals[outside], spacing)
    pattern = {"duvet": 4.0, "grass": 9.0, "carpet": 7.0, "floor": 2.0}[kind]
    stripes = 1.0 + 0.25 * np.sin(pattern * samples.points[:, :1]) * np.sin(0.7 * pattern * samples.points[:, 1:2])
    away = np.linalg.norm(samples.points - [0.0, 0.0, 0.2], axis=1)[:, None]
    shadow = 1.0 - (0.5 if light is None else 0.25) * np.exp(-((away / 0.55) ** 2))
    albedo = np.array(colour) * stripes * shadow
    return _painted(samples, albedo, _lit(samples, groups, light), random, plain=False)


def _lit(samples: SurfaceSamples, groups: list[_SolidGroup], light: SceneLight | None) -> np.ndarray:
    """Return the irradiance (n,) of surface samples."""
    if light is not None:
        return light.irradiance(samples.points, samples.normals, [one for group in groups for one in group.solids])
    key = KEY_LIGHT / np.linalg.norm(KEY_LIGHT)
    return 0.45 + 0.35 * np.clip(samples.normals @ key, 0.0, None) + 0.2 * np.clip(samples.normals[:, 2], 0.0, None)


def _painted(
    samples: SurfaceSamples, albedo: np.ndarray, lit: np.ndarray, random: np.random.Generator, *, plain: bool
) -> dict[str, np.ndarray]:
    """Return the arrays of flat Gaussians of one surface with irradiance ``lit`` (n,); on a ``plain`` surface they have
    similar colours."""
    noise = random.normal(1.0, 0.02 if plain else 0.10, (len(samples.points), 1))
    colour = np.clip(1.3 * albedo * lit[:, None] * noise, 0.0, 1.0) ** (1.0 / 2.2)
    cloud = flat_gaussians(samples, ((colour - 0.5) / SH_BAND_0)[:, None], random=random, device="cpu")
    return {key: getattr(cloud, key).numpy() for key in ARRAYS}


def _bridge(fields: dict[str, np.ndarray], is_object: np.ndarray, random: np.random.Generator) -> None:
    """Widen half of the Gaussians where the object touches its surroundings, and mix their colours with the colours of
    the other side."""
    means, sh, scales = fields["means"], fields["sh"].copy(), fields["log_scales"]
    for side in (is_object, ~is_object):
        own, other = np.flatnonzero(side), np.flatnonzero(~side)
        away, nearest = KDTree(means[other]).query(means[own])
        near = (away < _BRIDGE) & (random.uniform(size=len(own)) < 0.5)
        wide, across = own[near], other[np.ravel(nearest)[near]]
        scales[wide] += random.uniform(0.4, 1.1, (len(wide), 1))
        scales[wide, 2] = scales[wide].max(axis=1) - random.uniform(0.2, 1.0, len(wide))
        share = random.uniform(0.1, 0.5, (len(wide), 1, 1))
        sh[wide] = (1.0 - share) * fields["sh"][wide] + share * fields["sh"][across]
    fields["sh"] = sh


def _blades(
    relief: Relief, groups: list[_SolidGroup], density: float, random: np.random.Generator
) -> dict[str, np.ndarray]:
    """Return blades of grass: long, thin, nearly upright Gaussians outside all solids."""
    count = int(9000 * density)
    flat = 2.2 * random.uniform(-1.0, 1.0, (count, 2))
    length = random.uniform(0.02, 0.05, count)
    means = np.column_stack([flat, relief(flat) + length])
    outside = ~np.any([one.contains(means) for group in groups for one in group.solids], axis=0)
    means, length = means[outside], length[outside]
    lean = Rotation.from_rotvec(random.normal(0.0, 0.35, (len(means), 3)) * [1.0, 1.0, 0.0])
    green = np.array([0.25, 0.45, 0.12]) * random.uniform(0.6, 1.3, (len(means), 1))
    return {
        "means": means,
        "rotations": lean.as_quat()[:, [3, 0, 1, 2]],
        "log_scales": np.log(np.column_stack([0.12 * length, 0.12 * length, length])),
        "opacity_logits": random.normal(2.0, 0.7, len(means)),
        "sh": ((green - 0.5) / SH_BAND_0)[:, None],
    }


def _haze(fields: dict[str, np.ndarray], random: np.random.Generator) -> dict[str, np.ndarray]:
    """Return faint wide Gaussians in the air around the object."""
    count = int(_HAZE_SHARE * len(fields["means"]))
    return {
        "means": random.normal(0.0, 1.2, (count, 3)) * [1.0, 1.0, 0.6] + [0.0, 0.0, 1.0],
        "rotations": random.normal(size=(count, 4)),
        "log_scales": random.uniform(np.log(0.02), np.log(0.15), (count, 3)),
        "opacity_logits": random.normal(-3.5, 0.7, count),
        "sh": random.normal(0.0, 0.4, (count, 1, 3)),
    }


def _added(
    fields: dict[str, np.ndarray], is_object: np.ndarray, more: dict[str, np.ndarray]
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    longer = {key: np.concatenate([fields[key], more[key]]) for key in fields}
    return longer, np.concatenate([is_object, np.zeros(len(more["means"]), bool)])


def _camera(layout: SceneLayout, random: np.random.Generator) -> Camera:
    """Return a camera held by hand on the accessible side of the object, in portrait or landscape."""
    low, high = (-180.0, 180.0)
    if layout.support in ("chair", "sofa", "shelf") or set(layout.neighbours) & {"wall", "table"}:
        low, high = (-150.0, -30.0)
    if "wardrobe" in layout.neighbours:
        low, high = (-105.0, -30.0) if "wall" in layout.neighbours else (-105.0, 75.0)
    under = "table" in layout.neighbours or layout.support == "shelf"
    azimuth, elevation = np.radians([random.uniform(low, high), random.uniform(8.0, 32.0 if under else 55.0)])
    away = random.uniform(1.9, 3.2) * np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    middle = np.array([0.0, 0.0, 0.45])
    width, height = _SIDES if random.uniform() < 0.5 else _SIDES[::-1]
    camera = Camera.look_at(
        middle + away,
        middle + random.normal(0.0, 0.08, 3),
        np.array([*random.normal(0.0, 0.04, 2), 1.0]),
        width=width,
        height=height,
        vertical_fov_degrees=58.0 if height > width else 45.0,
    )
    return replace(camera, near=0.05)


def _in_any_frame(
    cloud: GaussianCloud, cameras: list[Camera], random: np.random.Generator
) -> tuple[GaussianCloud, list[Camera], BodyFrame]:
    """Return the capture and its cameras in an arbitrary frame and unit of length, and the room's frame in it."""
    turn = Rotation.random(rng=random)
    scale, shift = float(random.uniform(0.4, 2.5)), random.normal(size=3)
    rotations = turn * Rotation.from_quat(cloud.rotations.numpy()[:, [1, 2, 3, 0]])
    moved = GaussianCloud.from_numpy(
        scale * turn.apply(cloud.means.numpy()) + shift,
        rotations.as_quat()[:, [3, 0, 1, 2]],
        cloud.log_scales.numpy() + np.log(scale),
        cloud.opacity_logits.numpy(),
        cloud.sh.numpy(),
        device=str(cloud.device),
    )
    seen = []
    for camera in cameras:
        rotation = camera.rotation @ turn.as_matrix().T
        seen.append(
            replace(
                camera,
                rotation=rotation,
                translation=scale * camera.translation - rotation @ shift,
                near=scale * camera.near,
            )
        )
    return moved, seen, BodyFrame(turn.as_matrix().T, shift, 1.0 / scale)
