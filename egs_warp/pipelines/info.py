"""Inspection of a capture: up direction, front, base, feet, size, muscles, and the motions that the body can
perform."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING

import numpy as np

from egs_warp.contact.detection import contact_geometry
from egs_warp.errors import UserError
from egs_warp.fem.body import SoftBody, make_body
from egs_warp.geometry.body_frame import GROUND
from egs_warp.geometry.camera_ring import ring_camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.io.atomic import atomic_write
from egs_warp.locomotion.objectives import BodyPart
from egs_warp.motions.feet import Foot, SupportKind, order_counterclockwise, support_kind_of
from egs_warp.motions.follow import describe_position, head_note, parts_of_body
from egs_warp.motions.gestures import waving_part_text
from egs_warp.motions.repertoire import MOTIONS
from egs_warp.motions.script import refusal
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import SOLE_HEIGHT
from egs_warp.muscles.fibres import FibreKind
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.muscles.plot import FIBRE_COLOURS
from egs_warp.pipelines.balance import own_muscles_notes
from egs_warp.pipelines.capture_warnings import capture_warnings
from egs_warp.pipelines.creature import CONTACT_GRID, body_muscles, captured_stance
from egs_warp.pipelines.facing_direction import Front
from egs_warp.pipelines.placed_cage import PlacedCage, check_front, choose_front, place_cage
from egs_warp.render.rasteriser import render_gaussians

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SIDE = 480
"""Width and height, in pixels, of the picture of the capture."""
_EXTENT_QUANTILE = 0.995
"""Quantile of coordinates that defines the extent of a capture; the outermost Gaussians may be floaters."""
_MAX_GAP = 0.05
"""Distance above the ground, in body heights, beyond which a body is rejected."""
_PALE = 0.82
"""Grey value of parts that are not limbs, 0 to 1."""
_LINE = 68
"""Number of characters per line of the picture."""
_MARGIN = 16
"""Margin around the capture in the picture, pixels."""
_GAP = 4.0
"""Distance in pixels between the bar of the height and its number."""
_LABEL = 26.0
"""Minimum distance in pixels between the numbers of two feet."""


@dataclass(frozen=True)
class CaptureExtent:
    """Size of a whole capture, which is known even if it contains no body."""

    source: str
    """Name of the capture."""
    count: int
    """Number of its Gaussians."""
    extent: np.ndarray
    """(2, 3) corners of the box around nearly all Gaussians, capture's units."""

    @classmethod
    def of(cls, cloud: GaussianCloud, source: str = "capture") -> CaptureExtent:
        """Measure the capture ``cloud`` with the name ``source``."""
        shares = [1.0 - _EXTENT_QUANTILE, _EXTENT_QUANTILE]
        return cls(source, cloud.count, np.quantile(cloud.means.numpy().astype(np.float64), shares, axis=0))

    def lines(self) -> list[str]:
        """Return the lines for the terminal, in the capture's units."""
        low, high = self.extent
        return [
            f"capture  {self.source}: {self.count} Gaussians",
            f"extent   {_position(low)} to {_position(high)}, middle {_position(0.5 * (low + high))}",
        ]


@dataclass(frozen=True)
class BodyInfo:
    """Properties of a capture before its weight deforms it, in metres and in the frame of the body."""

    capture: CaptureExtent
    """The whole capture, of which the body may be a part."""
    count: int
    """Number of Gaussians of the body."""
    standing: PlacedCage
    body: SoftBody
    muscles: MuscleSet
    front: Front
    base: SupportKind
    place: Stance
    feet: tuple[Foot, ...]
    """Feet in the order of their numbers: counterclockwise as seen from above, starting straight ahead."""
    notes: tuple[str, ...]

    def soles(self) -> np.ndarray:
        """Return the centres of the soles (feet, 3), m: forward, left and up from the projection of the centre of mass
        onto the ground."""
        local = self.place.ground.local(self.place.standing)
        return np.array([local[foot.sole].mean(axis=0) for foot in self.feet]).reshape(-1, 3)

    @cached_property
    def parts(self) -> tuple[BodyPart, ...]:
        """Head and branches, to which keyframes may refer by name (``parts_of_body``)."""
        return tuple(
            part for part in parts_of_body(self.place) if part.name == "head" or part.name.startswith("branch")
        )

    def motions(self) -> dict[str, str | None]:
        """Return for each motion the reason why the body cannot perform it, or None if it can."""
        return {name: refusal(name, self.place) for name in MOTIONS}

    def lines(self) -> list[str]:
        """Return the lines for the terminal; lengths without a unit are in body heights."""
        frame, height = self.standing.frame, self.body.height
        up, ahead = (_numbers(frame.axes.T @ view) for view in (GROUND.normal, self.front.direction))
        alternative = self.front.alternative
        other = "" if alternative is None else f", but may be {_numbers(frame.axes.T @ alternative)}"
        plane = Plane(frame.axes[2], -float(frame.axes[2] @ frame.origin))
        size = np.ptp(self.place.ground.local(self.place.standing), axis=0) / height
        mesh, kinds = self.standing.cage.mesh, self._kinds()
        is_part = self.count < self.capture.count
        lines = [
            *self.capture.lines(),
            *([f"object   {self.count} Gaussians"] if is_part else []),
            f"up       {up}",
            f"ground   {_numbers(plane.normal, 4)},{plane.offset:.4g}",
            f"front    {ahead}{other}" + (" as given" if self.front.reason is None else f" ({self.front.reason})"),
            f"height   {height / frame.scale:.4g} of the capture's units, {height:.4g} m; {size[0]:.2f} long,"
            f" {size[1]:.2f} wide",
            f"cage     {len(mesh.nodes)} nodes, {len(mesh.tets)} tetrahedra",
            f"stands   on {self.stands()}",
        ]
        for number, (foot, sole) in enumerate(zip(self.feet, self.soles() / height, strict=True), start=1):
            lines.append(
                f"  foot {number}: {describe_position(sole)}, leg {foot.length / height:.2f}{_foot_note(foot, height)}"
            )
        for part in self.parts:
            local = self.place.ground.local(self.place.standing[part.nodes]) / height
            span = f"{local[:, 2].min():.2f} to {local[:, 2].max():.2f} up"
            lines.append(f"  {part.name}: {describe_position(local.mean(axis=0))}, {span}")
        lines.append(
            f"muscles  {self.muscles.fibre_count} fibres, {self.muscles.segment_count} segments"
            f" ({', '.join(f'{count} {kind.value}' for kind, count in kinds.items())})"
        )
        motions = self.motions()
        width = max(map(len, motions))
        for name, why in motions.items():
            needs = MOTIONS[name].file
            can = f"yes, with {needs}" if needs is not None else "yes"
            if name == "wave" and why is None:
                can = f"yes, with {waving_part_text(self.place)}"
            lines.append(f"{name:<{width}} {can if why is None else f'no: {why}'}")
        about_head = head_note(self.place, self.parts)
        return [*lines, *(f"note: {note}" for note in (*self.notes, *([] if about_head is None else [about_head])))]

    def _kinds(self) -> dict[FibreKind, int]:
        return dict(Counter(self.muscles.fibre_kinds[fibre] for fibre in self.muscles.fibre_from_segment))

    def stands(self) -> str:
        """Return a description of the support on which the body stands, for the user."""
        if self.base is SupportKind.FEET:
            return f"{len(self.feet)} feet, numbered anticlockwise from straight ahead"
        return {
            SupportKind.SINGLE_BASE: "one base",
            SupportKind.ROUND_BASE: "a round base: it rolls",
            SupportKind.LYING: "its length: it crawls",
        }[self.base]


def _numbers(vector: np.ndarray, digits: int = 2) -> str:
    # Adding zero avoids "-0.00".
    return ",".join(f"{x + 0.0:.{digits}f}" for x in np.round(vector, digits))


def _position(point: np.ndarray) -> str:
    return ",".join(f"{x + 0.0:.3g}" for x in point)


def _foot_note(foot: Foot, height: float) -> str:
    short = f", ends {foot.height / height:.3f} over the ground" if foot.height > 0.0 else ""
    return f"{short}{', joined to another in the cage' if foot.is_joined else ''}"


def inspect_capture(
    cloud: GaussianCloud,
    *,
    capture: CaptureExtent | None = None,
    up: np.ndarray | None = None,
    plane: Plane | None = None,
    front: np.ndarray | None = None,
    metres_per_unit: float | None = None,
    muscles_file: Path | None = None,
    nodes: int = 500,
    notes: tuple[str, ...] = (),
    progress: Callable[[str], object] = lambda stage: None,
) -> BodyInfo:
    """Determine the properties that ``make_creature`` finds in a capture.

    The body is simulated only if muscles from a file have to be checked (``balance_note``).

    Args:
        cloud: The capture, or an object of it.
        capture: The whole capture; None if it is ``cloud``.
        up: (3,) Up in the capture's frame.
        plane: Ground plane in the capture's frame; None uses the base of the object.
        front: (3,) Facing direction in the capture's frame; None estimates it.
        metres_per_unit: Length of one unit of the capture, m; None makes the body 1 m tall.
        muscles_file: File of muscles (``body_muscles``); None creates automatic muscles.
        nodes: Approximate number of cage nodes.
        notes: Notes for the user, to which others are appended.
        progress: Called with the name of each stage as it starts.

    Raises:
        UserError: As for ``make_creature``.
    """
    normal = plane.normal if plane is not None else up
    if front is not None and normal is not None:
        check_front(normal, front)
    progress("cage")
    standing = place_cage(cloud, up=up, plane=plane, metres_per_unit=metres_per_unit, nodes=nodes)
    mesh = standing.cage.mesh
    height = standing.cage.height(GROUND)
    lowest = float(mesh.nodes[:, 2].min())
    if lowest > _MAX_GAP * height:
        raise UserError(
            f"object: its body hangs {lowest / height:.2g} of its height above the ground that was"
            f" {'found' if plane is None else 'given'}; lower parts of the capture are not connected to the body:"
            " cut them away, or give the ground",
            check=("plane", "up"),
        )
    progress("front")
    faces = choose_front(standing, front)
    progress("muscles")
    body = make_body(mesh, GROUND, device=str(cloud.device))
    muscles = body_muscles(body, muscles_file, standing.frame)
    geometry = contact_geometry(
        standing.gaussians, mesh, (GROUND,), grid=CONTACT_GRID * height, device=str(cloud.device)
    )
    place = captured_stance(standing, faces, body, geometry)
    feet = place.feet()
    base = support_kind_of(mesh, mesh.nodes[:, 2], len(feet))
    if len(feet) > 1:
        soles = np.array([place.ground.local(mesh.nodes[foot.sole])[:, :2].mean(axis=0) for foot in feet])
        feet = tuple(feet[index] for index in order_counterclockwise(soles))
    notes = (*notes, *capture_warnings(standing.gaussians, mesh, body.height, thickening=standing.cage.thickening))
    if standing.gaussians.count < cloud.count:
        notes = (*notes, f"the body is measured from {standing.gaussians.count} of the {cloud.count} Gaussians")
    if muscles_file is not None:
        progress("balance")
        notes = (*notes, *own_muscles_notes(cloud, standing, faces, muscles_file))
    capture = capture or CaptureExtent.of(cloud)
    return BodyInfo(capture, cloud.count, standing, body, muscles, faces, base, place, feet, notes)


_HEAD_COLOUR, _BRANCH_COLOUR = "#f2c14e", "#9fd3c7"
_COLOURS = ("#d62728", "#1f77b4", "#2ca02c", "#ff7f0e", "#9467bd", "#8c564b", "#e377c2", "#17becf")


def draw_info(path: Path, info: BodyInfo) -> None:
    """Write a picture (.png): views of the capture from front and left, its limbs, muscles and feet, and ``lines``.

    Raises ``UserError`` if ``path`` cannot be written.
    """
    # Imported here because the import takes a quarter of a second.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(20.0, 10.0), layout="constrained")
    grid = figure.add_gridspec(2, 8)
    views = {"from the front": (1.0, 0.0), "from its left": (0.0, 1.0)}
    for column, (title, view) in enumerate(views.items()):
        axes = figure.add_subplot(grid[0, 2 * column : 2 * column + 2])
        _draw_capture(axes, info, np.array(view))
        axes.set_title(title)
    _draw_base(figure.add_subplot(grid[0, 4:6]), info)
    _draw_cage(figure.add_subplot(grid[1, :3]), info)
    _draw_muscles(figure.add_subplot(grid[1, 3:6]), info)
    _write_lines(figure.add_subplot(grid[:, 6:]), info)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=100, format="png", facecolor="white")


def _draw_capture(axes: Axes, info: BodyInfo, view: np.ndarray) -> None:
    """Draw the capture as seen from the direction ``view`` (2,) (forward, left), and mark its feet, height and
    front."""
    ground, nodes, height = info.place.ground, info.place.standing, info.body.height
    middle = 0.5 * (nodes.min(axis=0) + nodes.max(axis=0))
    direction = np.array([*view, 0.12]) / np.hypot(1.0, 0.12) @ ground.axes
    radius = 1.1 * float(np.linalg.norm(nodes - middle, axis=1).max())
    camera = ring_camera(direction, middle, radius, GROUND.normal, size=_SIDE, vertical_fov_degrees=24.0)
    image = render_gaussians(info.standing.gaussians, camera, background=(1.0, 1.0, 1.0))
    axes.imshow(image.colour_srgb8())

    def pixels(points: np.ndarray) -> np.ndarray:
        seen = np.atleast_2d(points) @ camera.rotation.T + camera.translation
        return seen[:, :2] / seen[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]

    numbered: list[np.ndarray] = []
    for number, foot in enumerate(info.feet):
        sole = nodes[foot.sole].mean(axis=0)
        leg = np.flatnonzero(foot.leg > 0.0) if len(info.feet) > 1 else foot.sole
        top = nodes[leg[nodes[leg, 2] > 0.7 * foot.length]] if len(info.feet) > 1 else nodes[:0]
        line = pixels(np.stack([sole, top.mean(axis=0)]) if len(top) else sole)
        colour = _COLOURS[number % len(_COLOURS)]
        axes.plot(*line.T, color=colour, linewidth=3.0, alpha=0.8)
        while numbered and np.linalg.norm(numbered - line[0], axis=1).min() < _LABEL:
            line[0, 1] += _LABEL
        numbered.append(line[0])
        _number(axes, line[0], number + 1, colour)
    edge = nodes[:, 2].max() * GROUND.normal + middle * [1.0, 1.0, 0.0]
    aside = ground.axes[1] * view[0] - ground.axes[0] * view[1]
    reach = float(np.abs((nodes - middle) @ aside).max()) + 0.08 * height
    # From the left, the bar is behind the body, because the arrow is in front of it.
    side = 1.0 if view[0] == 0.0 else -1.0
    bar = pixels(np.stack([edge * [1.0, 1.0, 0.0], edge]) + side * reach * aside)
    axes.annotate("", bar[1], bar[0], arrowprops={"arrowstyle": "<->", "color": "0.3"})
    units = height / info.standing.frame.scale
    x, y = bar.mean(axis=0).tolist()
    x += side * _GAP
    axes.text(x, y, f"{units:.3g}", rotation=90, ha="left" if side > 0.0 else "right", va="center", color="0.3")
    seen = np.concatenate([pixels(nodes), bar])
    if view[0] == 0.0:
        ahead = float(ground.local(nodes)[:, 0].max())
        arrow = pixels(ground.world(np.array([[ahead + 0.05 * height, 0.0, 0.0], [ahead + 0.35 * height, 0.0, 0.0]])))
        _arrow(axes, arrow, "front")
        seen = np.concatenate([seen, arrow])
    low, high = seen.min(axis=0) - _MARGIN, seen.max(axis=0) + _MARGIN
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(high[1], low[1])
    axes.axis("off")


def _draw_base(axes: Axes, info: BodyInfo) -> None:
    """Draw the outline of the body, the soles and the centre of mass from above, with the front upwards."""
    height = info.body.height
    local = info.place.ground.local(info.place.standing) / height

    def flat(points: np.ndarray) -> np.ndarray:
        return np.stack([-points[:, 1], points[:, 0]], axis=1)

    _fill(axes, flat(local), "0.93")
    _fill(axes, flat(local[local[:, 2] < SOLE_HEIGHT]), "0.8")
    for number, foot in enumerate(info.feet):
        colour = _COLOURS[number % len(_COLOURS)]
        points = flat(local[foot.sole])
        _fill(axes, points, colour, alpha=0.35)
        axes.plot(*points.T, ".", color=colour, markersize=4.0)
        _number(axes, points.mean(axis=0), number + 1, colour)
    axes.plot(0.0, 0.0, "k+", markersize=14.0)
    reach = float(np.abs(local[:, :2]).max())
    _arrow(axes, np.array([[0.0, 1.05 * reach], [0.0, 1.35 * reach]]), "front")
    axes.set_ylim(-1.1 * reach, 1.45 * reach)
    axes.set_xlim(-1.1 * reach, 1.1 * reach)
    axes.set_aspect("equal")
    stands = f"{len(info.feet)} feet" if info.base is SupportKind.FEET else info.base.value
    axes.set_title(f"stands on {stands}; from above")
    axes.set_xlabel("to the right, body heights; + is under the centre of mass")
    axes.set_ylabel("ahead, body heights")


def _fill(axes: Axes, points: np.ndarray, colour: str, *, alpha: float = 1.0) -> None:
    """Fill the convex hull of ``points`` (n, 2)."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        corners = points[ConvexHull(points).vertices]
    except (QhullError, ValueError):  # There are fewer than three points, or they are collinear.
        return
    axes.fill(*corners.T, color=colour, alpha=alpha, linewidth=0.0)


def _number(axes: Axes, place: np.ndarray, number: int, colour: str) -> None:
    style = {"boxstyle": "circle", "facecolor": colour, "edgecolor": "white"}
    x, y = place.tolist()
    axes.text(x, y, str(number), color="white", ha="center", va="center", weight="bold", bbox=style, zorder=5)


def _arrow(axes: Axes, line: np.ndarray, text: str) -> None:
    style = {"arrowstyle": "->", "linewidth": 2.0}
    axes.annotate(text, line[1], line[0], arrowprops=style, ha="center", va="center", annotation_clip=False)


def _three_quarters(info: BodyInfo) -> np.ndarray:
    """Return the axes (3, 3) of a view from the front left: right, up and towards the viewer."""
    eye = np.array([0.8, 0.6, 0.35])
    eye /= np.linalg.norm(eye)
    right = np.cross([0.0, 0.0, 1.0], eye)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(eye, right), eye]) @ info.place.ground.axes


def _draw_faces(axes: Axes, info: BodyInfo, *, limbs: bool) -> None:
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import to_rgb

    nodes, axis = info.place.standing, _three_quarters(info)
    faces = info.standing.cage.mesh.boundary_faces()
    corners = nodes[faces] @ axis.T
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    order = np.argsort(corners[:, :, 2].mean(axis=1))
    order = order[normals[order, 2] > 0.0]
    colours = np.full((len(nodes), 3), _PALE)
    if limbs and len(info.feet) > 1:
        for number, foot in enumerate(info.feet):
            share = foot.leg[:, None] > 0.0
            colours = np.where(share, to_rgb(_COLOURS[number % len(_COLOURS)]), colours)
    if limbs:
        for part in info.parts:
            colours[part.nodes] = to_rgb(_HEAD_COLOUR if part.name == "head" else _BRANCH_COLOUR)
    shade = (0.65 + 0.35 * normals[order, 2:]) * colours[faces[order]].mean(axis=1)
    line = 0.3 if limbs else 0.1
    axes.add_collection(
        PolyCollection(list(corners[order, :, :2]), facecolors=shade, edgecolors="0.4", linewidths=line)
    )
    flat = nodes @ axis[:2].T
    axes.set_xlim(flat[:, 0].min(), flat[:, 0].max())
    axes.set_ylim(flat[:, 1].min(), flat[:, 1].max())
    axes.set_aspect("equal")
    axes.axis("off")


def _draw_cage(axes: Axes, info: BodyInfo) -> None:
    _draw_faces(axes, info, limbs=True)
    axis = _three_quarters(info)
    for number, foot in enumerate(info.feet):
        place = axis[:2] @ info.place.standing[foot.sole].mean(axis=0)
        _number(axes, place, number + 1, _COLOURS[number % len(_COLOURS)])
    for part in info.parts:
        x, y = (axis[:2] @ info.place.standing[part.nodes].mean(axis=0)).tolist()
        axes.text(x, y, part.name, ha="center", va="center", fontsize="small", zorder=5)
    axes.set_title(f"cage of {len(info.place.standing)} nodes: legs, head and branches")


def _draw_muscles(axes: Axes, info: BodyInfo) -> None:
    _draw_faces(axes, info, limbs=False)
    muscles = info.muscles
    ends = muscles.end_points(info.place.standing) @ _three_quarters(info)[:2].T
    kinds = [muscles.fibre_kinds[fibre] for fibre in muscles.fibre_from_segment]
    for kind, count in info._kinds().items():
        own_segments = [
            segment for segment, segment_kind in zip(muscles.segments, kinds, strict=True) if segment_kind is kind
        ]
        for number, (first, last) in enumerate(own_segments):
            label = f"{kind.value} ({count})" if number == 0 else None
            axes.plot(
                *ends[[first, last]].T,
                color=FIBRE_COLOURS[kind],
                linewidth=1.8,
                marker=".",
                markersize=4.0,
                label=label,
            )
    axes.legend(fontsize="small", loc="lower center", ncols=3, frameon=False, bbox_to_anchor=(0.5, -0.12))
    axes.set_title(f"{muscles.segment_count} muscle segments")


def _write_lines(axes: Axes, info: BodyInfo) -> None:
    lines = [part for line in info.lines() for part in wrap(line, _LINE, subsequent_indent="         ")]
    size = min(11.0, 560.0 / max(len(lines), 1))
    axes.text(0.0, 1.0, "\n".join(lines), family="monospace", fontsize=size, va="top", transform=axes.transAxes)
    axes.axis("off")
