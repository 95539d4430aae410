"""Interactive picking of objects: state, history and proposals, independently of the page that shows them."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera, downscale
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.meshing.body_gaussians import centred, representatives
from egs_warp.pipelines.locate_plane import locate_plane
from egs_warp.pipelines.segmentation_warnings import is_large, views_at_edges
from egs_warp.pipelines.standing_object import MIN_LEDGE, MIN_SURROUNDING_SHARE
from egs_warp.render.rasteriser import render_gaussians
from egs_warp.segmentation.above_plane import MIN_OPACITY, SceneAbovePlane
from egs_warp.segmentation.base_plane import find_base_plane
from egs_warp.segmentation.clicks import Click, click_at
from egs_warp.segmentation.framing import outside_frames
from egs_warp.segmentation.ground import measure_ground
from egs_warp.segmentation.interactive import ClickGraph, segment_by_clicks
from egs_warp.segmentation.object_mask import foreign_haze
from egs_warp.segmentation.object_spec import ObjectSpec, Segmentation
from egs_warp.segmentation.outline import ledge_around
from egs_warp.segmentation.plane_search import find_planes
from egs_warp.segmentation.resting_plane import resting_plane
from egs_warp.segmentation.table_top import planes_below, surface_around

_MAX_TILT, _MAX_TILT_OF_CAMERAS = 25.0, 10.0
"""Maximum angle between the normal of the ground and the up direction, degrees: for an up direction that does not come
from cameras, and for one that does, as in ``locate_plane``."""
_MAX_OUTSIDE = 0.02
"""Share of the opaque Gaussians that are outside the frame of a photo, averaged over the photos, below which the
capture is considered one object. The share is 0 to 0.003 for an object on a white desk or a turntable, and 0.29 to 0.65
for rooms."""
_MAX_OUTSIDE_OF_OBJECT = 0.5
"""Share of the photos whose frames do not contain a Gaussian above which the Gaussian does not belong to an object that
is alone in its capture."""
_MIN_SUPPORT = 0.15
"""Minimum share of the visible surface on the widest plane for it to be the ground of a scene."""
_MAX_BELOW = 0.3
"""Maximum share of the opaque Gaussians that may be below the ground."""
_STANDING = 0.03
"""Height above the ground above which Gaussians belong to objects on it, as a fraction of the capture's height."""
_MAX_TABLE_DISTANCE = 0.7
"""Maximum height of a click above a table top that replaces the wide plane, as a fraction of its height above the wide
plane."""
_STRAY, _LOW_PART = 0.1, 0.3
"""Share of an object's Gaussians that may be strays below its ground, and quantile of the heights at which surfaces
below the object are searched."""
_LOWEST = 0.002
"""Quantile of the heights that is the height of the lowest parts of an object."""
_SUNK, _HANGING = 0.05, 0.1
"""Distances below and above a plane, as fractions of the object's size, within which the object stands on the plane."""
_VIEWS, _SIDE = 6, 160
"""Number of pictures in which an object is tested, and their longer side in pixels."""
_MIN_COVERED = 0.01
"""Minimum fraction of a photo that a whole object covers. It is not tiny, because photographers fill the picture with
the object."""
_MAX_SHARED = 0.005
"""Maximum share of an object's Gaussians that may belong to another object, too, without a warning."""
_SEED_COUNT = 8
"""Number of Gaussians nearest to the middle of a scene from which the proposal starts."""
_OPAQUE = 0.3
MAX_STEPS = 100
"""Maximum number of changes that can be undone."""


@dataclass(frozen=True)
class Pick:
    """One object: the marks of the user, and the Gaussians that they select."""

    name: str
    plane: Plane
    """Ground plane under the object."""
    mask: np.ndarray
    """(n,) bool, True for the Gaussians of the object."""
    clicks: tuple[Click, ...] = ()
    front: np.ndarray | None = None
    """(3,) facing direction that the user has given; None to estimate it."""
    proposal: np.ndarray | None = None
    """(n,) bool, initial selection that the clicks modify, from a file or a proposal; None for an empty one."""
    outside: np.ndarray | None = None
    """(n,) for each Gaussian, the share of the photos whose frames do not contain it; None if it is unknown."""
    is_alone: bool = False
    """True if the photos show that the capture contains nothing but the object."""
    is_guess: bool = False
    """True if the proposal is a guess, which is replaced by a click elsewhere."""
    is_plane_given: bool = False
    """True if the user has set the plane."""
    wide_plane: Plane | None = None
    """Ground of the scene, if ``plane`` is a higher surface that was found under the object; otherwise None."""

    @property
    def scene_plane(self) -> Plane:
        """Ground with which another object begins: the plane that the user has set, or else the ground of the scene."""
        return self.plane if self.is_plane_given or self.wide_plane is None else self.wide_plane

    def standing_on(self, plane: Plane) -> Pick:
        """Return the object on ``plane``, which was found under it."""
        return replace(self, plane=plane, wide_plane=self.wide_plane or self.plane)

    @property
    def points(self) -> np.ndarray:
        """(k,) int, indices of the Gaussians."""
        return np.flatnonzero(self.mask)


@dataclass(frozen=True)
class PickState:
    """All objects, and the active one, at one point of the history."""

    picks: tuple[Pick, ...]
    active: int = 0

    @property
    def pick(self) -> Pick:
        """The active object."""
        return self.picks[self.active]

    def with_pick(self, pick: Pick) -> PickState:
        """Return the state with the active object replaced by ``pick``."""
        return replace(self, picks=(*self.picks[: self.active], pick, *self.picks[self.active + 1 :]))

    def with_new(self, pick: Pick) -> PickState:
        """Return the state with an additional object, which becomes the active one."""
        return PickState((*self.picks, pick), len(self.picks))

    def selecting(self, index: int) -> PickState:
        """Return the state with object ``index`` active."""
        return replace(self, active=min(max(index, 0), len(self.picks) - 1))

    def without_active(self) -> PickState:
        """Return the state without the active object. If it is the only object, it is emptied instead."""
        if len(self.picks) == 1:
            empty = np.zeros_like(self.pick.mask)
            pick = self.pick
            return self.with_pick(Pick(pick.name, pick.scene_plane, empty, is_plane_given=pick.is_plane_given))
        rest = (*self.picks[: self.active], *self.picks[self.active + 1 :])
        return PickState(rest, min(self.active, len(rest) - 1))

    def free_name(self) -> str:
        """Return an unused name for a new object."""
        names = {one.name for one in self.picks}
        return next(f"object {number}" for number in range(1, len(names) + 2) if f"object {number}" not in names)

    def overlaps(self) -> tuple[str, ...]:
        """Return a warning, with a remedy, for each other object that shares Gaussians with the active one."""
        own = self.pick.mask
        shared = [(int((one.mask & own).sum()), one.name) for k, one in enumerate(self.picks) if k != self.active]
        return tuple(
            f"{count:,} of its Gaussians belong to {name}, too; remove them from one of the two"
            for count, name in shared
            if count > _MAX_SHARED * own.sum()
        )

    def labels(self) -> np.ndarray:
        """Return the labels (n,) uint8: for each Gaussian, the number of the object to which it belongs, counted from
        1, or 0 for none. The active object has precedence."""
        labels = np.zeros(len(self.pick.mask), np.uint8)
        for number, one in enumerate(self.picks, start=1):
            labels[one.mask] = number
        labels[self.pick.mask] = self.active + 1
        return labels


class PickHistory:
    """History of states for undo and redo."""

    def __init__(self, state: PickState) -> None:
        self._states, self._at = [state], 0

    @property
    def state(self) -> PickState:
        """The current state."""
        return self._states[self._at]

    @property
    def can_undo(self) -> bool:
        """True if there is an earlier state."""
        return self._at > 0

    @property
    def can_redo(self) -> bool:
        """True if there is an undone state."""
        return self._at < len(self._states) - 1

    def push(self, state: PickState) -> None:
        """Make ``state`` the current one; undone states are dropped."""
        self._states = [*self._states[: self._at + 1], state][-MAX_STEPS - 1 :]
        self._at = len(self._states) - 1

    def amend(self, state: PickState) -> None:
        """Replace the current state, so that the change does not become a separate step for undo and redo."""
        self._states[self._at] = state

    def move(self, *, redo: bool) -> bool:
        """Undo or redo a step; return False if there is none."""
        if not (self.can_redo if redo else self.can_undo):
            return False
        self._at += 1 if redo else -1
        return True


def stroke_at(
    cloud: GaussianCloud, camera: Camera, pixels: Sequence[tuple[float, float]], *, inside: bool
) -> Click | None:
    """Return one click with the hits at all ``pixels`` of the picture of ``camera``; None if no pixel shows a
    Gaussian."""
    clicks = [click_at(cloud, camera, u, v, inside=inside) for u, v in pixels]
    found = [click for click in clicks if click is not None]
    if not found:
        return None
    return replace(found[0], hits=np.unique(np.concatenate([click.hits for click in found])))


def marked(graph: ClickGraph, pick: Pick, click: Click) -> Pick:
    """Return ``pick`` after one more click. If the first click misses a guessed proposal, the click replaces the
    proposal. A click below the surface that was found under the object adds what is on the ground of the scene."""
    hits_proposal = pick.proposal is not None and bool(pick.proposal[click.hits].any())
    if pick.is_guess and click.inside and not hits_proposal:
        pick = replace(pick, proposal=None)
    if click.inside and pick.plane.heights(click.point) < 0.0:
        pick = replace(pick, plane=pick.scene_plane)
    return resegmented(graph, replace(pick, clicks=(*pick.clicks, click), is_guess=False))


def resegmented(graph: ClickGraph, pick: Pick) -> Pick:
    """Return ``pick`` with the Gaussians that its clicks select above its plane."""
    return replace(
        pick, mask=segment_by_clicks(graph, pick.clicks, pick.plane, proposal=pick.proposal, outside=pick.outside)
    )


def on_table_top(graph: ClickGraph, pick: Pick) -> Pick:
    """Return ``pick`` on the table top under its lowest click, if there is one above its plane and the plane was not
    set by the user."""
    points = [click.point for click in pick.clicks if click.inside]
    if pick.is_plane_given or not points:
        return pick
    up = pick.plane.normal
    lowest = min(points, key=lambda point: float(point @ up))
    for plane in planes_below(graph.cloud, up, lowest):
        if plane.heights(lowest) > _MAX_TABLE_DISTANCE * pick.plane.heights(lowest):
            break
        standing = resegmented(graph, pick.standing_on(plane))
        if not standing.mask.any():
            continue
        nothing = np.zeros_like(standing.mask)
        found = Segmentation(standing.mask, nothing, nothing, size_of(graph, standing))
        if found.size > 0.0 and surface_around(graph.cloud, plane, found) > MIN_SURROUNDING_SHARE:
            return standing
    return pick


def located(graph: ClickGraph, pick: Pick) -> Pick:
    """Return ``pick`` after its first click, with the object and the ground that ``locate_plane`` finds at the clicked
    point, as ``animate`` and ``segment`` do for ``--object x,y,z``. The object is the proposal that further clicks
    modify. ``pick`` is returned if the user has set the plane, or if no object is found."""
    if pick.is_plane_given or not pick.clicks:
        return pick
    try:
        found = locate_plane(graph.cloud, ObjectSpec(point=pick.clicks[0].point), up=pick.plane.normal)
    except UserError:
        return pick
    mask = found.segmentation.object_mask
    return replace(pick.standing_on(found.plane), mask=mask, proposal=mask)


def is_grounded(graph: ClickGraph, pick: Pick) -> bool:
    """Return True if no ground has to be found for the selection: it stands on its plane, the user has set the plane,
    it is the whole capture, or nothing is selected."""
    size = size_of(graph, pick)
    if pick.is_plane_given or pick.is_alone or size == 0.0:
        return True
    low, lowest = np.quantile(pick.plane.heights(graph.means[pick.mask]), [_STRAY, _LOWEST])
    return bool(low > -_SUNK * size and lowest < _HANGING * size)


def regrounded(graph: ClickGraph, pick: Pick) -> Pick:
    """Return ``pick`` on the level surface on which its selection stands, without what is below this surface.

    A change of the selection may leave the object in the air, because a base under it was removed, or below the plane,
    because a base was added. The surface is then the highest one below the object that surrounds it, or else, if the
    last click removed what was under the object, a plane under the lowest parts of what is left. ``pick`` is returned
    if it ``is_grounded``, or if no surface is found.
    """
    if is_grounded(graph, pick):
        return pick
    size, own, up = size_of(graph, pick), graph.means[pick.mask], pick.plane.normal
    lowest = float(np.quantile(pick.plane.heights(own), _LOWEST))
    rise = own @ up
    point = own[np.argsort(rise, kind="stable")[int(_LOW_PART * len(own))]]
    for plane in planes_below(graph.cloud, up, point):
        heights = plane.heights(graph.means)
        low = float(np.quantile(heights[pick.mask], _STRAY))
        if not -_SUNK * size < low < _HANGING * size:
            continue
        standing = replace(pick.standing_on(plane), mask=pick.mask & (heights > 0.0))
        nothing = np.zeros_like(pick.mask)
        found = Segmentation(standing.mask, nothing, nothing, size_of(graph, standing))
        if found.size > 0.0 and (
            surface_around(graph.cloud, plane, found) > MIN_SURROUNDING_SHARE
            or ledge_around(graph.cloud, plane, found) >= MIN_LEDGE
        ):
            return standing
    last = pick.clicks[-1] if pick.clicks else None
    if lowest < _HANGING * size or last is None or last.inside or pick.plane.heights(last.point) > lowest:
        return pick
    # No surface is visible under what is left, such as the upper half of a block.
    return pick.standing_on(pick.plane.moved(lowest * up))


def proposed(graph: ClickGraph, up: np.ndarray, *, cameras: Sequence[Camera] = ()) -> Pick:
    """Return the proposal before any clicks: the ground, and the object in the middle.

    A capture is considered one object on its base if there is no wide plane under it, or if its opaque Gaussians are in
    the frames of nearly all photos: each photo of a room shows surroundings that other photos do not show.

    Args:
        graph: the prepared capture.
        up: (3,) up direction.
        cameras: cameras of the photos, in the frame of ``graph``. The object is what the cameras look at and keep in
            their frames. Without cameras, the object is in the middle of what stands on the ground.
    """
    cloud, opaque = graph.cloud, graph.cloud.visible(_OPAQUE)
    middle = looked_at(cameras)
    outside = None if middle is None else outside_frames(graph.means, middle, cameras)
    plane = None if _is_alone(cloud, outside) else _wide_plane(graph, up, opaque, middle)
    if plane is None:
        return _whole(graph, up, cameras, outside)
    heights = plane.heights(graph.means)
    standing = np.flatnonzero(opaque & (heights > max(_STANDING * float(np.quantile(heights[opaque], 0.99)), 0.0)))
    empty = Pick("object 1", plane, np.zeros(cloud.count, bool))
    if len(standing) == 0:
        return empty
    if middle is None:
        middle = np.median(graph.means[standing], axis=0)
    away = np.linalg.norm(graph.means[standing] - middle, axis=1)
    hits = standing[np.argsort(away, kind="stable")[:_SEED_COUNT]]
    guess = resegmented(graph, replace(empty, clicks=(Click(graph.means[hits[0]], hits),), outside=outside))
    guess = on_table_top(graph, guess)
    if is_large(graph.means, guess.mask, guess.plane, whole=graph.middles):
        # A guess that contains half of a room is a bad proposal.
        return empty
    # Drop ``outside``: the user's clicks may select another object, which the photos do not keep in their frames.
    return replace(guess, clicks=(), outside=None, proposal=guess.mask, is_guess=True)


def _is_alone(cloud: GaussianCloud, outside: np.ndarray | None) -> bool:
    """Return True if the capture contains only one object, because nearly all opaque Gaussians are inside the frames of
    nearly all photos. ``outside`` is as in ``Pick``."""
    solid = cloud.visible(MIN_OPACITY)
    return outside is not None and bool(solid.any()) and float(outside[solid].mean()) < _MAX_OUTSIDE


def _wide_plane(graph: ClickGraph, up: np.ndarray, opaque: np.ndarray, middle: np.ndarray | None) -> Plane | None:
    """Return the widest plane that can be the ground of a scene and that is below ``middle`` (3,), if this is given;
    None if there is no such plane."""
    for one in find_planes(graph.cloud, up, tilt_degrees=_MAX_TILT if middle is None else _MAX_TILT_OF_CAMERAS):
        if one.support <= _MIN_SUPPORT or not opaque.any():
            return None
        heights = one.plane.heights(graph.means[opaque])
        is_low = (heights < -_STANDING * np.quantile(heights, 0.99)).mean() <= _MAX_BELOW
        if is_low and (middle is None or one.plane.heights(middle) > 0.0):
            return one.plane
    return None


def _whole(graph: ClickGraph, up: np.ndarray, cameras: Sequence[Camera], outside: np.ndarray | None) -> Pick:
    """Return the whole capture as one object on its base, without the haze around it.

    The up direction of cameras is as uncertain as they were rolled. Within this angle, the object rests on its lowest
    parts. Without cameras, ``up`` (3,) is exact. ``outside`` is as in ``Pick``. Only for an object that is alone, what
    most photos do not show is haze.
    """
    is_alone = _is_alone(graph.cloud, outside)
    is_framed = np.ones(graph.cloud.count, bool)
    if is_alone and outside is not None:
        is_framed = outside < _MAX_OUTSIDE_OF_OBJECT
    plane = _base_plane(graph.cloud.subset(is_framed), up)
    whole = is_framed & (plane.heights(graph.means) > 0.0)
    size = size_of(graph, Pick("", plane, whole))
    if outside is not None and size > 0.0:
        with contextlib.suppress(UserError):
            tilt = min(_roll(cameras, up), _MAX_TILT_OF_CAMERAS)
            plane = resting_plane(graph.cloud, whole, plane, up, degrees=tilt, size=size)
            whole = is_framed & (plane.heights(graph.means) > 0.0)
    if whole.any():
        whole &= ~foreign_haze(SceneAbovePlane.of(graph.cloud, plane), whole, size_of(graph, Pick("", plane, whole)))
    return Pick("object 1", plane, whole, proposal=whole, is_guess=True, is_alone=is_alone)


def _roll(cameras: Sequence[Camera], up: np.ndarray) -> float:
    """Return the root mean square, degrees, of the angles between the ``cameras``' image x axes and the level plane
    orthogonal to ``up`` (3,)."""
    sines = np.clip(np.stack([camera.rotation[0] for camera in cameras]) @ up / np.linalg.norm(up), -1.0, 1.0)
    return float(np.degrees(np.sqrt(np.mean(np.arcsin(sines) ** 2))))


def _base_plane(cloud: GaussianCloud, up: np.ndarray) -> Plane:
    """Return the plane on which a capture of one object stands."""
    near, anchor = centred(representatives(cloud))
    try:
        return find_base_plane(near, up).moved(anchor)
    except UserError:
        lowest = float(np.quantile(cloud.means.numpy() @ up, 0.005))
        return Plane(up, -lowest)


def size_of(graph: ClickGraph, pick: Pick) -> float:
    """Return the diagonal of the object's bounding box without outliers, scene units; 0 for an empty object."""
    if not pick.mask.any():
        return 0.0
    low, high = np.quantile(graph.means[pick.mask], [0.005, 0.995], axis=0)
    return float(np.linalg.norm(high - low))


def pick_warnings(graph: ClickGraph, pick: Pick) -> tuple[str, ...]:
    """Return warnings about an object, each with a remedy. An object that is alone in its capture may be large without
    a warning."""
    count = int(pick.mask.sum())
    if count == 0:
        return ()
    warnings = []
    if not pick.is_alone and is_large(graph.means, pick.mask, pick.plane, whole=graph.middles):
        share = 100.0 * count / len(pick.mask)
        warnings.append(f"it has {share:.0f} % of the capture; if other things lit up, remove them")
    size = size_of(graph, pick)
    if not (pick.plane.heights(graph.means[pick.mask]) > 0.0).any():
        warnings.append("nothing of it is above the ground; drag the ground down, or click on the object")
        return tuple(warnings)
    lowest = float(np.quantile(pick.plane.heights(graph.means[pick.mask]), 0.002))
    if lowest > _HANGING * size:
        warnings.append(f"it hangs {lowest / size:.2f} of its size above the ground; drag the ground to its feet")
    return tuple(warnings)


def photo_warnings(cloud: GaussianCloud, mask: np.ndarray, cameras: Sequence[Camera]) -> tuple[str, ...]:
    """Return a warning with a remedy if the object ``mask`` (n,) bool of ``cloud`` touches nearly all edges of a
    picture, as a room does, or covers only a very small part of the pictures, as a fragment does."""
    tested = [downscale(camera, _SIDE) for camera in cameras[:: max(1, len(cameras) // _VIEWS)]][:_VIEWS]
    if not tested or not mask.any():
        return ()
    object_cloud = cloud.subset(mask)
    all_round, _ = views_at_edges(object_cloud, tested)
    if all_round:
        return (
            f"it touches the picture's edges all round in {all_round} of {len(tested)} photos, so its surroundings are"
            " included; remove what does not belong to it",
        )
    covered = [float((render_gaussians(object_cloud, one).alpha.numpy() > 0.5).mean()) for one in tested]
    if np.median(covered) < _MIN_COVERED:
        return (f"it covers {100.0 * np.median(covered):.1f} % of the photos; if it is only a part, click on the rest",)
    return ()


def ground_around(
    cloud: GaussianCloud, mask: np.ndarray, plane: Plane, cameras: Sequence[Camera] = ()
) -> HeightField | None:
    """Return the uneven ground around the object ``mask`` (n,) bool of ``cloud``, measured as for ``animate``; None if
    it is flat, or if the capture contains only the object.

    Args:
        cloud: the capture.
        mask: the object.
        plane: the plane under it.
        cameras: cameras of the capture, if known.
    """
    if not mask.any() or mask.all():
        return None
    points = cloud.means.numpy()[mask].astype(np.float64)
    low, high = np.quantile(points, [0.005, 0.995], axis=0)
    size, height = float(np.linalg.norm(high - low)), float(np.quantile(plane.heights(points), 0.998))
    if size == 0.0 or height <= 0.0:
        return None
    measured = measure_ground(cloud, mask, plane, cameras=cameras, centre=0.5 * (low + high), size=size)
    return None if measured.is_flat(height) else measured.field


def looked_at(cameras: Sequence[Camera]) -> np.ndarray | None:
    """Return the point (3,) that is nearest to the optical axes of all ``cameras``; None for fewer than three."""
    if len(cameras) < 3:
        return None
    across = [np.eye(3) - np.outer(camera.rotation[2], camera.rotation[2]) for camera in cameras]
    centres = [camera.centre for camera in cameras]
    matrix = np.sum(across, axis=0)
    if np.linalg.cond(matrix) > 1e6:
        return None
    return np.linalg.solve(matrix, np.sum([one @ centre for one, centre in zip(across, centres, strict=True)], axis=0))
