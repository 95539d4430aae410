"""Relative places of two bodies at the start of a run: overlap, the body on which another one stands, and parts that
are too thin for contact."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull

from egs_warp.contact.terrain import Solid
from egs_warp.geometry.body_frame import GROUND
from egs_warp.geometry.plane import Plane
from egs_warp.pipelines.captured_body import CapturedBody

_ON_BODY = 0.08
"""Maximum distance between the base of a body and the top of another body on which it stands, in heights of the
first."""
_MAX_THIN_LENGTH = 0.1
"""Length in body heights up to which a part may be thinner than the level set resolves without a note."""


def is_below(other: CapturedBody, body: CapturedBody) -> bool:
    """Return True if ``body`` stands on ``other``: the top of its box is at the base of the body."""
    points, others = body.contact_points(), other.contact_points()
    low, high = others.min(axis=0), others.max(axis=0)
    over = ((points[:, :2] > low[:2]) & (points[:, :2] < high[:2])).all(axis=1)
    return bool(over.any() and abs(points[over, 2].min() - high[2]) < _ON_BODY * body.body.height)


def column_below(body: CapturedBody, height: float, tolerance: float) -> Solid:
    """Return a solid with its top at ``height`` metres, below the hull of the contact points of ``body`` that are at
    least this high, up to the ``tolerance``."""
    points = body.contact_points()
    top = points[points[:, 2] > height - tolerance]
    # Qhull moves the points slightly ("QJ"), so that points on one line have a hull, too.
    sides = ConvexHull((top if len(top) > 2 else points)[:, :2], qhull_options="QJ").equations
    walls = [Plane(np.array([x, y, 0.0]), offset) for x, y, offset in sides]
    return Solid((Plane(GROUND.normal, -height), *walls))


def boxes_overlap(body: CapturedBody, other: CapturedBody, margin: float) -> bool:
    """Return True if the boxes around the contact points of two bodies are at most ``margin`` metres apart."""
    points, others = body.contact_points(), other.contact_points()
    gaps = np.maximum(points.min(axis=0) - others.max(axis=0), others.min(axis=0) - points.max(axis=0))
    return bool((gaps <= margin).all())


def depth(body: CapturedBody, other: CapturedBody) -> float:
    """Return the depth (m) of the deepest contact point of ``body`` in ``other``; 0 if their boxes do not overlap."""
    if not boxes_overlap(body, other, 0.0):
        return 0.0
    shape, at = other.body, other.start.positions
    turn = shape.best_fit_rotation(at)
    rest = (body.contact_points() - shape.centre_of_mass(at)) @ turn + shape.centre_of_mass(shape.mesh.nodes)
    return max(0.0, -float(other.shape.level_set.evaluate(rest)[0].min()))


def thin_part_note(name: str, body: CapturedBody) -> str | None:
    """Return a note if a part that is longer than ``_MAX_THIN_LENGTH`` is too thin for contact with other bodies."""
    thin = body.shape.thin_parts
    if thin.lengths.max(initial=0.0) <= _MAX_THIN_LENGTH * body.body.height:
        return None
    x, y, z = body.placement.turn @ thin.centres[0] + body.placement.shift
    return (
        f"{name}: a part of it, {thin.lengths[0]:.2f} m long, is thinner than {thin.thickness:.2g} m; other bodies may "
        f"pass through it at {x:.2f},{y:.2f},{z:.2f}"
    )
