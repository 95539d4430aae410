"""From a capture of a scene to an object, the plane it stands on, and a background without it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from egs_warp.commands.object_flag import shrunk
from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.camera_ring import ring_cameras
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.inpainting.holes import Hole
from egs_warp.inpainting.rectified import PlaneWindow
from egs_warp.io.planes import write_planes
from egs_warp.io.ply import write_ply
from egs_warp.segmentation.base_plane import guess_up
from egs_warp.segmentation.clearance import Clearing, ClearingOptions, clear_plane, reach_across
from egs_warp.segmentation.connectivity import enclosed
from egs_warp.segmentation.object_mask import CELLS, ObjectSpec, Segmentation, segment, votes_of_masks
from egs_warp.segmentation.plane_fit import PlaneFit
from egs_warp.segmentation.plane_search import find_planes, plane_under, refine_plane

if TYPE_CHECKING:
    from egs_warp.inpainting.inpaint import InpaintResult
    from egs_warp.inpainting.inpainters import Inpainter
    from egs_warp.training.finetune import TrainingView

_PLANE_ELEVATIONS = (40.0, 58.0, 75.0)
"""Degrees: seen at a grazing angle, splats in front hide those behind, and the floor seems to lie higher."""
_HOLE_HEIGHT = 0.08
"""Of the object's size: under what it has below this height the floor is unseen, or seen so badly that it is smeared."""
_HOLE_TEXELS = 200
_CLEAR_SUPPORT = 0.1
"""Share of the visible surface: a plane as wide as this is no accident."""
_LEVEL_DEGREES = 5.0
_PLANE_SIDE = 400
"""Pixels of the pictures that the plane is fitted to."""


@dataclass(frozen=True)
class SceneOptions:
    """What may be chosen."""

    clearing: Clearing | None = None
    """None: fine-tuning where PyTorch is installed, else the static split."""
    inpaint: bool = True
    inpainter: Inpainter | None = None
    """None: patch synthesis."""
    clearing_options: ClearingOptions = field(default_factory=ClearingOptions)


@dataclass(frozen=True)
class LocatedPlane:
    """The plane under the object, and where on it the object is."""

    plane: Plane
    fit: PlaneFit | None
    """None where the plane was given."""
    centre: np.ndarray
    """(3,) middle of the object."""
    size: float
    """Scene units: diagonal of the object's bounding box."""
    segmentation: Segmentation
    notes: tuple[str, ...]

    def facts(self) -> dict[str, object]:
        """What ``plane.json`` says beside the plane itself."""
        fit = self.fit
        return {"centre": self.centre.tolist(), "size": self.size} | (
            {} if fit is None else {"noise": fit.noise, "inlier_share": fit.inlier_share, "pixels": fit.pixel_count}
        )


@dataclass(frozen=True)
class PreparedScene:
    """A capture taken apart; scene units."""

    object: GaussianCloud
    """Clear of the plane."""
    background: GaussianCloud
    """Without the object; with new floor where it stood, if that was asked for."""
    bare: GaussianCloud
    """The background before inpainting."""
    plane: Plane
    hole: Hole
    """In the floor, under the object."""
    located: LocatedPlane
    notes: tuple[str, ...]
    """What was found and done, for the user."""
    filled: InpaintResult | None = None
    """How the background got its new floor; None where it got none."""

    def write(self, folder: Path, known: Sequence[tuple[Plane, Mapping[str, object]]] = ()) -> None:
        """``object.ply``, ``background.ply`` and ``plane.json`` into ``folder``.

        ``known`` is what the file that gave the plane held; what is not found anew goes along.
        """
        write_ply(folder / "object.ply", self.object)
        write_ply(folder / "background.ply", self.background)
        facts = dict(known[0][1]) if known else {}
        facts |= self.located.facts() | {"hole": self.hole.facts()}
        entries = [(self.plane, facts), *known[1:]]
        write_planes(folder / "plane.json", [plane for plane, _ in entries], facts=[said for _, said in entries])


def prepare_scene(
    cloud: GaussianCloud,
    spec: ObjectSpec,
    *,
    cameras: Sequence[Camera] = (),
    photographs: Sequence[TrainingView] | None = None,
    up: np.ndarray | None = None,
    plane: Plane | None = None,
    options: SceneOptions | None = None,
    progress: Callable[[str], None] = lambda stage: None,
) -> PreparedScene:
    """Everything between a capture and its animation: plane, segmentation, clearing of the plane, inpainting.

    ``cameras`` are the capture's own, if known; ``photographs`` of the whole scene take the place of renders in the
    fine-tune at the plane; ``up`` (3,) is roughly up, and guessed if not given; ``progress`` is
    told the name of each stage. Raises ``UserError`` as the stages do.
    """
    options = options or SceneOptions()
    progress("plane")
    located = locate_plane(cloud, spec, cameras=cameras, up=up, plane=plane)
    progress("segment")
    thing, bare, notes = take_apart(cloud, located, options, photographs)
    filled, hole = None, hole_under(cloud, located)
    if options.inpaint:
        progress("inpaint")
        # torch may be missing, and with it the training that inpainting ends with.
        from egs_warp.inpainting.inpaint import InpaintOptions, inpaint

        steps = {} if has_torch() else {"steps": 0}
        try:
            filled = inpaint(bare, hole, inpainter=options.inpainter, options=InpaintOptions(**steps))
            notes = (*notes, *filled.notes)
        except UserError as error:
            # A floor with a hole is worth more than no animation.
            notes = (*notes, f"the floor under the object was not filled ({error})")
    background = bare if filled is None else filled.cloud
    return PreparedScene(thing, background, bare, located.plane, hole, located, (*located.notes, *notes), filled)


def take_apart(
    cloud: GaussianCloud,
    located: LocatedPlane,
    options: SceneOptions,
    photographs: Sequence[TrainingView] | None = None,
) -> tuple[GaussianCloud, GaussianCloud, tuple[str, ...]]:
    """Object, clear of the plane; background with a hole; and what there is to say."""
    found = located.segmentation
    method = options.clearing or (Clearing.FINETUNE if has_torch() else Clearing.SPLIT)
    untouched = cloud.subset(found.object_mask)
    heights, reach = reach_across(untouched, located.plane, options.clearing_options.reach)
    if not found.background_mask.any():
        raise UserError("object: it is the whole capture, so there is no background; leave --object out")
    thing = clear_plane(
        untouched,
        located.plane,
        method,
        views=photographs or None,
        surroundings=cloud.subset(~found.object_mask) if photographs else None,
        options=options.clearing_options,
    )
    notes = (
        f"the object has {untouched.count} of {cloud.count} Gaussians; {int(found.buried_mask.sum())} under it and "
        f"{int(found.floater_mask.sum())} floaters beside it were dropped",
        f"{int((np.abs(heights) < reach).sum())} of the object's Gaussians straddled the plane: {method.value}"
        + (f" against {len(photographs)} photographs" if photographs and method is Clearing.FINETUNE else ""),
    )
    return thing, cloud.subset(found.background_mask), notes


def hole_under(cloud: GaussianCloud, located: LocatedPlane) -> Hole:
    """Where the floor is missing: the outline of the object's low part and of what was dropped from under it, filled."""
    plane, found = located.plane, located.segmentation
    means = cloud.means.numpy().astype(np.float64)
    low = found.buried_mask | (found.object_mask & (plane.heights(means) < _HOLE_HEIGHT * found.size))
    middle = 0.5 * (means[low].min(axis=0) + means[low].max(axis=0))
    tangents = np.stack(plane.tangents(), axis=1)
    flat = means[low] @ tangents
    texel = 1.2 * float(np.ptp(flat, axis=0).max()) / _HOLE_TEXELS
    window = PlaneWindow(plane, middle - plane.heights(middle) * plane.normal, texel, _HOLE_TEXELS, _HOLE_TEXELS)
    columns, rows = np.meshgrid(np.arange(_HOLE_TEXELS) + 0.5, np.arange(_HOLE_TEXELS) + 0.5)
    places = window.points(np.stack([columns.ravel(), rows.ravel()], axis=1))
    inside = enclosed(places @ tangents, flat, found.size / CELLS)
    return Hole(window, inside.reshape(_HOLE_TEXELS, _HOLE_TEXELS))


def viewing_direction(scene: PreparedScene, cameras: Sequence[Camera]) -> np.ndarray:
    """(3,) from the object to where a picture is best taken: where the capture's own cameras were, or else from half above.

    Captures look best from where they were taken; of those cameras it is the one of median height.
    """
    normal, centre = scene.plane.normal, scene.located.centre
    away = [camera.centre - centre for camera in cameras if scene.plane.heights(camera.centre) > 0.0]
    if away:
        sines = np.array([direction @ normal / np.linalg.norm(direction) for direction in away])
        return away[int(np.argsort(sines)[len(sines) // 2])]
    # Of eight sides, the one on which the least stands between the camera and the object.
    means, opacity = scene.background.means.numpy().astype(np.float64), scene.background.opacities()
    first, second = scene.plane.tangents()
    level = means - centre - ((means - centre) @ normal)[:, None] * normal
    standing = (scene.plane.heights(means) > 0.1 * scene.located.size) & (opacity > 0.3)
    directions = [np.cos(a) * first + np.sin(a) * second for a in np.arange(8) * np.pi / 4.0 - 0.5 * np.pi + 0.35]
    blocked = [int(np.count_nonzero(standing & (level @ d > 0.7 * np.linalg.norm(level, axis=1)))) for d in directions]
    return directions[int(np.argmin(blocked))] + 0.5 * normal


def has_torch() -> bool:
    """Whether training is possible."""
    return find_spec("torch") is not None


def locate_plane(
    cloud: GaussianCloud,
    spec: ObjectSpec,
    *,
    cameras: Sequence[Camera] = (),
    up: np.ndarray | None = None,
    plane: Plane | None = None,
) -> LocatedPlane:
    """The plane under the object, and the object on it.

    A coarse plane is sampled from the Gaussians, the object found on it, and the plane then fitted to the depth rendered
    beside the object, through ``cameras`` or else a ring of steep ones; then the object is found again. With ``plane``
    given, only the object is sought.
    """
    notes: list[str] = []
    if plane is not None:
        found = segment(cloud, plane, spec)
        return LocatedPlane(plane, None, _middle(cloud, found), found.size, found, ())
    if up is None:
        up, reason = _up_of(cloud, cameras)
        notes.append(f"up is taken to be {','.join(f'{x:.2f}' for x in up)} ({reason}); if not, give --up")
    coarse = _coarse_plane(cloud, spec, up)
    found = segment(cloud, coarse, spec)
    centre = _middle(cloud, found)
    radius = 0.75 * found.size
    if cameras:
        views = [shrunk(camera, _PLANE_SIDE) for camera in cameras]
    else:
        level = centre - coarse.heights(centre) * coarse.normal
        views = ring_cameras(coarse, level, radius, count=9, elevations=_PLANE_ELEVATIONS, size=_PLANE_SIDE)
    fit = refine_plane(cloud, coarse, views, centre=centre, radius=radius, object_mask=~found.background_mask)
    found = segment(cloud, fit.plane, spec)
    notes.append(
        f"plane {','.join(f'{x:.4f}' for x in (*fit.plane.normal, fit.plane.offset))}: fits {fit.pixel_count} pixels "
        f"to {100 * fit.noise:.2f} % of depth, {100 * fit.inlier_share:.0f} % of them inliers"
    )
    return LocatedPlane(fit.plane, fit, _middle(cloud, found), found.size, found, tuple(notes))


def _middle(cloud: GaussianCloud, found: Segmentation) -> np.ndarray:
    means = cloud.means.numpy()[found.object_mask].astype(np.float64)
    return 0.5 * (np.quantile(means, 0.01, axis=0) + np.quantile(means, 0.99, axis=0))


def _up_of(cloud: GaussianCloud, cameras: Sequence[Camera]) -> tuple[np.ndarray, str]:
    if len(cameras) >= 3:
        # Photographers hold cameras upright: the directions to the right span the level plane.
        rights = np.stack([camera.rotation[0] for camera in cameras])
        values, vectors = np.linalg.eigh(rights.T @ rights)
        ups = -np.stack([camera.rotation[1] for camera in cameras]).mean(axis=0)
        if values[0] < 0.1 * values[1]:
            axis = vectors[:, 0]
            return axis * (1.0 if axis @ ups > 0 else -1.0), "the cameras are held upright"
    return guess_up(cloud)


def _coarse_plane(cloud: GaussianCloud, spec: ObjectSpec, up: np.ndarray) -> Plane:
    means = cloud.means.numpy().astype(np.float64)
    everywhere = find_planes(cloud, up)
    # The widest plane tells up better than a guess does, and what objects stand on is level.
    if everywhere and everywhere[0].support > _CLEAR_SUPPORT:
        up = everywhere[0].plane.normal
    searched, least_share = cloud, 0.3
    if spec.box is not None:
        if not spec.box.holds(means).any():
            raise UserError("object: the box holds nothing of the capture; give it in the capture's units")
        middle, half = 0.5 * (spec.box.low + spec.box.high), 0.5 * (spec.box.high - spec.box.low)
        searched = cloud.subset(np.all(np.abs(means - middle) < 1.5 * half, axis=1))
        reach = float(np.abs(up) @ half)
        lowest = middle - 0.5 * reach * up
        least_share = 0.5
    elif spec.masks:
        lowest = _low_point(cloud, spec, means, up)
    else:
        assert spec.point is not None
        lowest = spec.point
    planes = find_planes(searched, up, tilt_degrees=_LEVEL_DEGREES)
    plane = plane_under(planes, lowest, tolerance=0.0, least_share=least_share)
    if plane is None and spec.masks and planes:
        raise UserError(
            "object: most of the mask lies on the floor, not on an object that stands on it; mark the object, or check "
            "--view and --up"
        )
    if plane is None:
        raise UserError(
            "plane: none in sight under the object: nothing flat and level lies below it; check --up, or give --plane"
        )
    return plane


def _low_point(cloud: GaussianCloud, spec: ObjectSpec, means: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(3,) a place in the lower third of what the masks show; never below the object's foot."""
    votes = votes_of_masks(cloud, spec.masks)
    inside = votes.inside * (votes.share_inside() > 0.5) * (votes.share_seen() > 0.02)
    if inside.sum() <= 0.0:
        raise UserError("object: nothing of the capture shows inside the masks; check masks and cameras")
    order = np.argsort(means @ up)
    share = np.cumsum(inside[order]) / inside.sum()
    return means[order[int(np.searchsorted(share, 0.3))]]
