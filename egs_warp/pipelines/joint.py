"""Joints of a world: a point of a body is tied to its place, or to a point of another body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from egs_warp.errors import UserError
from egs_warp.fem.joints import BodyPoint, JointRows, PointJoint
from egs_warp.pipelines.captured_body import CapturedBody
from egs_warp.short_repr import short_repr

_MAX_OUTSIDE = 0.05
"""Maximum distance of a point of a joint from the surface of its body, outside the body, in body heights."""
_REDUNDANT = 1e-6
"""Smallest singular value of the rows of all joints, divided by the largest one, at which they are independent."""


@dataclass(frozen=True, eq=False)
class PlacedJoint:
    """A joint of a world, as returned by ``World.add_joint``."""

    __repr__ = short_repr

    bodies: tuple[str, ...]
    """Names of the one or two bodies."""
    point_joint: PointJoint
    """Points of the bodies, which are indices in the world."""


def body_point(name: str, body: CapturedBody, index: int, place: np.ndarray) -> BodyPoint:
    """Return the point of a body that is at ``place`` at the start.

    Args:
        name: name of the body, for the message.
        body: the body.
        index: index of the body in the world.
        place: (3,) m, in the frame of the world.

    Raises:
        UserError: the place is outside the body.
    """
    tets = body.mesh.tets
    corners = body.start.positions[tets]
    later = np.einsum("ti,tij->tj", place - corners[:, 0], np.linalg.inv(corners[:, 1:] - corners[:, :1]))
    weights = np.hstack([1.0 - later.sum(axis=1, keepdims=True), later])
    tet = int(weights.min(axis=1).argmax())
    rest = weights[tet] @ body.mesh.nodes[tets[tet]]
    outside = float(body.shape.level_set.evaluate(rest[None])[0][0])
    if outside > _MAX_OUTSIDE * body.body.height:
        raise UserError(
            f"joint at {place_text(place)}: this is {outside:.2g} m outside {name}; give a point inside it, or move it"
            " there"
        )
    return BodyPoint(index, tets[tet], weights[tet])


def check_independent(joints: Sequence[PointJoint], bodies: Sequence[CapturedBody], is_driven: Sequence[bool]) -> None:
    """Raise ``UserError`` if the last of the ``joints`` holds points that cannot move apart anyway, such as a third
    joint on the line of a hinge.

    Args:
        joints: all joints of the world.
        bodies: all bodies of the world.
        is_driven: True for bodies that follow a path.
    """
    counts = [len(body.mesh.nodes) for body in bodies]
    rows = JointRows.of(joints, np.cumsum([0, *counts])).matrix
    values = np.linalg.svd(rows[:, np.repeat(~np.asarray(is_driven), 3 * np.asarray(counts))], compute_uv=False)
    if len(values) < len(rows) or values[-1] < _REDUNDANT * values[0]:
        raise UserError(
            f"joint at {place_text(joints[-1].place)}: earlier joints hold this point already; leave the joint out"
        )


def place_text(place: np.ndarray) -> str:
    """Return a place (3,) m as text."""
    # Adding zero turns -0 into 0.
    return f"({', '.join(f'{value:.2f}' for value in np.round(place, 2) + 0.0)})"
