"""Preparation of several objects of one scene, one after the other: each object is cut out, and its hole is filled."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np
from scipy.spatial import KDTree

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.frames import Direction, direction_of
from egs_warp.geometry.gaussians import GaussianCloud, concatenate
from egs_warp.geometry.plane import Plane
from egs_warp.notes import prefixed
from egs_warp.pipelines.locate_plane import locate_plane
from egs_warp.pipelines.prepare_scene import PreparedScene, SceneOptions, prepare_scene
from egs_warp.segmentation.clicks import Click
from egs_warp.segmentation.object_spec import ObjectSpec
from egs_warp.segmentation.votes import votes_of_masks
from egs_warp.short_repr import short_repr

_NEW = -1
"""Index of a Gaussian that is not in the original capture."""
_NEAR_POINT = 16
"""Number of Gaussians nearest to a point that count as selected by it."""
_MAX_SHARED = 0.5
"""Maximum fraction of the selected Gaussians that may belong to objects that were cut out before."""
_NOTED = 0.01
"""Fraction of shared Gaussians above which a note is written."""
_PICKED_NEIGHBOURS = 8
"""Number of neighbours that decide whether new floor belongs to a picked object."""
_MIN_TOP, _ON_TOP = 0.05, 0.08
"""Minimum height above the object's plane, and maximum distance from the object, of new floor that belongs to the
object; both relative to the size of the object."""
_MAX_TILT, _MAX_OFFSET = 3.0, 0.03
"""Maximum angle in degrees between the planes of two objects that stand on the same ground, and maximum distance
between the planes, as a fraction of the size of the smaller object."""


class Preparer(Protocol):
    """Function that prepares one object of a scene (``prepare_scene`` with its cameras and options)."""

    def __call__(
        self, cloud: GaussianCloud, spec: ObjectSpec, *, up: Direction | None, plane: Plane | None
    ) -> PreparedScene:
        """Cut the object out of ``cloud``."""
        ...


@dataclass(frozen=True)
class PreparedObjects:
    """A capture that is separated into several objects and a background, in scene units."""

    __repr__ = short_repr

    scenes: Mapping[str, PreparedScene]
    """The preparation of each object by its name, in the order of the cuts. The input of each preparation is the
    background of the previous one."""
    planes: Mapping[str, Plane]
    """Plane under each object. All planes are parallel, and objects on the same ground have the same plane."""
    notes: tuple[str, ...]
    """Notes for the user; a note about an object begins with its name."""

    @property
    def background(self) -> GaussianCloud:
        """The capture without the objects, with filled holes."""
        return list(self.scenes.values())[-1].background

    @property
    def lowest_plane(self) -> Plane:
        """The lowest of the planes."""
        return min(self.planes.values(), key=lambda plane: -plane.offset)


def prepare_objects(
    cloud: GaussianCloud,
    specs: Mapping[str, ObjectSpec],
    *,
    cameras: Sequence[Camera] = (),
    up: Direction | None = None,
    planes: Mapping[str, Plane] | None = None,
    options: SceneOptions | None = None,
    prepare: Preparer | None = None,
    progress: Callable[[str], object] = lambda name: None,
    show_object: Callable[[str, PreparedScene], object] = lambda name, scene: None,
) -> PreparedObjects:
    """Cut several objects out of a capture and fill their holes, one after the other.

    Each object is searched for in the background that the previous object has left. Therefore, an object that stands on
    another one must come first: the hole that it leaves is then filled with the surface of the other object.

    Args:
        cloud: The capture.
        specs: Specification of each object by its name, in the order of the cuts.
        cameras: Cameras of the capture, if known.
        up: (3,) Approximate up direction, or an axis such as ``"-y"``; None as for ``prepare_scene``.
        planes: Planes under some of the objects, if they are known.
        options: Options; None uses the default.
        prepare: Function that prepares one object; None uses ``prepare_scene`` with ``cameras`` and ``options``.
        progress: Called with the name of each object before it is cut out.
        show_object: Called with the name and the preparation of each object when it is finished.

    Raises:
        UserError: A stage failed, or an object belongs to a previous object; the message begins with the name of the
            object.
    """
    if prepare is None:
        prepare = partial(prepare_scene, cameras=cameras, options=options)
    scenes: dict[str, PreparedScene] = {}
    notes: list[str] = []
    # Indices, in the capture, of the Gaussians of the remaining scene.
    origins = np.arange(cloud.count)
    owners = np.full(cloud.count, -1)
    rest = cloud
    for number, (name, spec) in enumerate(specs.items()):
        progress(name)
        try:
            notes += [f"{name}: {note}" for note in _shared(cloud, spec, owners, list(scenes))]
            remaining, plane = _in_remaining_scene(spec, cloud, rest, origins), (planes or {}).get(name)
            try:
                scene = prepare(rest, remaining, up=up, plane=plane)
            except UserError:
                if plane is not None or rest is cloud:
                    raise
                # In the search for the plane, the new floor on top of this object may outweigh the surface on which the
                # object stands.
                plane = locate_plane(
                    cloud, spec, cameras=cameras, up=None if up is None else direction_of(up, "up")
                ).plane
                scene = prepare(rest, remaining, up=up, plane=plane)
        except UserError as error:
            raise UserError(f"{name}: {error}") from error
        segmentation = scene.located.segmentation
        cut = origins[segmentation.object_mask]
        owners[cut[cut != _NEW]] = number
        origins = origins[segmentation.background_mask]
        if scene.filled is not None:
            new = np.full(int(scene.filled.is_new.sum()), _NEW)
            origins = np.concatenate([origins[scene.filled.is_retained], new])
            earlier = (origins == _NEW) & ~scene.filled.is_new
            scene, origins = _with_new_floor(scene, origins, earlier)
        else:
            scene, origins = _with_new_floor(scene, origins, origins == _NEW)
        notes += [prefixed(name, note) for note in scene.notes]
        scenes[name], rest = scene, scene.background
        show_object(name, scene)
        up = scene.plane.normal if up is None else up
    return PreparedObjects(scenes, _common_planes(scenes), tuple(notes))


def _shared(cloud: GaussianCloud, spec: ObjectSpec, owners: np.ndarray, names: Sequence[str]) -> tuple[str, ...]:
    """Return a note if some of the Gaussians that ``spec`` selects belong to earlier objects, to which they then remain
    assigned.

    Args:
        cloud: The capture.
        spec: Specification of the object.
        owners: (n,) int, number of the object to which each Gaussian belongs; -1 for none.
        names: Names of the earlier objects.

    Raises:
        UserError: Most of the selected Gaussians belong to earlier objects.
    """
    selected = _selected(cloud, spec)
    taken = owners[selected] >= 0
    if not taken.any():
        return ()
    other = names[int(np.bincount(owners[selected][taken]).argmax())]
    share = float(taken.mean())
    if share > _MAX_SHARED:
        raise UserError(
            f"{100 * share:.0f} % of its selected Gaussians belong to {other}, which is cut out before it; give the"
            " object that stands on the other one first, or exclude this one from the other one with clicks -u,v@photo"
        )
    if share < _NOTED:
        return ()
    return (f"{100 * share:.0f} % of its selected Gaussians belong to {other}, which keeps them",)


def _selected(cloud: GaussianCloud, spec: ObjectSpec) -> np.ndarray:
    """Return the indices (k,) of the Gaussians that ``spec`` names directly, without a search for the object."""
    means = cloud.means.numpy().astype(np.float64)
    if spec.picked is not None:
        return np.flatnonzero(spec.picked)
    if spec.masks:
        votes = votes_of_masks(cloud, spec.masks)
        return np.flatnonzero(votes.inside > votes.outside)
    if spec.box is not None:
        return np.flatnonzero(spec.box.holds(means))
    hits = [click.hits for click in spec.clicks if click.inside]
    if hits:
        return np.unique(np.concatenate(hits))
    assert spec.point is not None
    return np.atleast_1d(KDTree(means).query(spec.point, k=min(_NEAR_POINT, cloud.count))[1])


def _in_remaining_scene(spec: ObjectSpec, cloud: GaussianCloud, rest: GaussianCloud, origins: np.ndarray) -> ObjectSpec:
    """Convert ``spec``, which refers to the Gaussians of ``cloud``, for the remaining scene ``rest``, whose Gaussians
    have the indices ``origins`` (m,) in ``cloud``. A Gaussian of new floor belongs to a picked object if most of its
    neighbours do."""
    if rest is cloud:
        return spec
    places = np.full(cloud.count, -1)
    known = np.flatnonzero(origins != _NEW)
    places[origins[known]] = known
    clicks = tuple(_moved_click(click, places) for click in spec.clicks)
    picked = spec.picked
    if picked is not None:
        chosen = np.zeros(rest.count, bool)
        chosen[known] = picked[origins[known]]
        new = np.flatnonzero(origins == _NEW)
        if len(new) and len(known) >= _PICKED_NEIGHBOURS:
            means = rest.means.numpy()
            neighbours = KDTree(means[known]).query(means[new], k=_PICKED_NEIGHBOURS)[1]
            chosen[new] = chosen[known][neighbours].mean(axis=1) > 0.5
        picked = chosen
    return replace(spec, clicks=clicks, picked=picked)


def _with_new_floor(
    scene: PreparedScene, origins: np.ndarray, is_earlier: np.ndarray
) -> tuple[PreparedScene, np.ndarray]:
    """Move new floor that lies on top of the object from the background to the object. This floor filled the hole of an
    earlier object, and the search for this object may have missed it.

    Args:
        scene: The prepared object.
        origins: (n,) int, index in the capture of each Gaussian of the background.
        is_earlier: (n,) bool, True for new floor of earlier holes.

    Returns:
        The object with this floor, and the indices of the remaining background.
    """
    size = scene.located.size
    means = scene.background.means.numpy().astype(np.float64)
    on_top = is_earlier & (scene.plane.heights(means) > _MIN_TOP * size)
    if on_top.any():
        distances = KDTree(scene.object.means.numpy()).query(means[on_top])[0]
        on_top[on_top] = distances < _ON_TOP * size
    if not on_top.any():
        return scene, origins
    moved = replace(
        scene,
        object=concatenate(scene.object, scene.background.subset(on_top)),
        background=scene.background.subset(~on_top),
    )
    return moved, origins[~on_top]


def _moved_click(click: Click, places: np.ndarray) -> Click:
    hits = places[click.hits]
    return replace(click, hits=hits[hits >= 0])


def _common_planes(scenes: Mapping[str, PreparedScene]) -> dict[str, Plane]:
    """Return the plane under each object: parallel planes, and one plane for objects on the same ground.

    The common normal is that of the plane that was fitted to the most pixels.
    """
    up = max(scenes.values(), key=lambda scene: scene.located.fit.pixel_count if scene.located.fit else 0).plane.normal
    planes: dict[str, Plane] = {}
    for name, scene in scenes.items():
        centre, size = scene.located.centre, scene.located.size
        foot = centre - float(scene.plane.heights(centre)) / float(scene.plane.normal @ up) * up
        level = Plane(up, -float(up @ foot))
        for other, plane in planes.items():
            smaller = min(size, scenes[other].located.size)
            tilt = float(np.degrees(np.arccos(np.clip(scene.plane.normal @ scenes[other].plane.normal, -1.0, 1.0))))
            if tilt < _MAX_TILT and abs(plane.offset - level.offset) < _MAX_OFFSET * smaller:
                level = plane
        planes[name] = level
    return planes
