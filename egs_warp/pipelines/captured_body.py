"""A captured object as a body of a simulation: its Gaussians, its stepper and its state at rest on the ground.

``Creature`` is a body with muscles, and ``Prop`` is a stiff body without muscles. ``CapturedBody.moved`` places a body
anywhere on the ground by moving only its state. The rest shape and all that is embedded in it (Gaussians, muscles,
contact points, level set) stay in the frame of the cage, so that copies of a body share them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Self, TypeAlias

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from egs_warp.checked_calls import Finite, Range, checked_method
from egs_warp.contact.detection import ContactGeometry, gaussian_arms
from egs_warp.contact.terrain import Surface
from egs_warp.deformation.rigid import to_body_frame
from egs_warp.errors import ArgumentError
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.geometry.body_frame import GROUND, BodyFrame
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.locomotion.body_support import Support
from egs_warp.locomotion.settling import settle
from egs_warp.locomotion.stepper import LocomotionStepper
from egs_warp.meshing.level_set import MAX_CELLS, LevelSet, ThinParts, level_set_of_body, thin_parts
from egs_warp.meshing.occupancy import LatticeSolid, solid_from_gaussians
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.short_repr import short_repr

FRICTION_RANGE = Range(0.0, 10.0, "a Coulomb coefficient")
"""Coulomb coefficients that can be requested."""
Friction: TypeAlias = Annotated[float, FRICTION_RANGE]
"""A Coulomb coefficient."""


@dataclass(frozen=True)
class CapturedShape:
    """Shape of a body as captured, in the frame of its cage, for contact with other bodies."""

    __repr__ = short_repr

    gaussians: GaussianCloud
    """Gaussians that define the body (``body_gaussians``), metres."""
    contact_points: np.ndarray
    """(P, 3) m, contact points at rest."""

    @cached_property
    def solid(self) -> LatticeSolid:
        """Solid of the Gaussians, on a lattice of ``MAX_CELLS`` cells."""
        return solid_from_gaussians(self.gaussians, resolution=MAX_CELLS)

    @cached_property
    def thin_parts(self) -> ThinParts:
        """Parts of the solid that are too thin for the level set."""
        return thin_parts(self.solid)

    @cached_property
    def level_set(self) -> LevelSet:
        """Level set of the shape (``level_set_of_body``) without detached fragments. The first access takes
        seconds."""
        means, arms = self.gaussians.means.numpy().astype(np.float64), gaussian_arms(self.gaussians)
        ends = np.concatenate([means, *(means + sign * arms[:, :, axis] for axis in range(3) for sign in (1.0, -1.0))])
        # A contact point belongs to the Gaussian whose mean or end point is nearest to it.
        gaussian = KDTree(ends).query(self.contact_points)[1] % len(means)
        return level_set_of_body(self.solid, self.contact_points[self.solid.is_near(means)[gaussian]])


@dataclass(frozen=True)
class Placement:
    """Rigid motion from the frame of the cage to the frame of the ground."""

    __repr__ = short_repr

    turn: np.ndarray = field(default_factory=lambda: np.eye(3))
    """(3, 3) rotation."""
    shift: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """(3,) m, translation after the rotation."""

    def then(self, turn: np.ndarray, shift: np.ndarray) -> Placement:
        """Return this motion followed by the rotation ``turn`` (3, 3) and the translation ``shift`` (3,) m."""
        return Placement(turn @ self.turn, turn @ self.shift + shift)

    def applied_to(self, state: BodyState) -> BodyState:
        """Transform a state from the frame of the cage to the frame of the ground. If the two frames are equal, the
        state is returned unchanged."""
        if np.array_equal(self.turn, np.eye(3)) and not self.shift.any():
            return state
        return replace(
            state, positions=state.positions @ self.turn.T + self.shift, velocities=state.velocities @ self.turn.T
        )


@dataclass(frozen=True, kw_only=True)
class CapturedBody:
    """Captured object with a soft body and a ground, at rest; lengths are in metres.

    ``cloud`` and the rest shape of ``stepper`` are in the frame of the cage, ``start`` is in the frame of the ground.
    The two frames are equal unless the body has been placed with ``moved``.
    """

    frame: BodyFrame
    """Frame of ``start`` in the capture."""
    cloud: GaussianCloud
    """The Gaussians of the capture, in their original order, in the frame of the cage."""
    stepper: LocomotionStepper
    """Solver with body, muscles and contact."""
    start: BodyState
    """State at rest on the ground."""
    solids: tuple[Surface, ...]
    """Surfaces that the body can touch; the first one is the ground."""
    shape: CapturedShape
    """Shape as captured, for contact with other bodies."""
    placement: Placement = field(default_factory=Placement)
    """Motion from the frame of the cage to that of ``start`` (``moved``)."""
    notes: tuple[str, ...] = ()
    """Guesses that were made about the capture, for the user."""
    support: Support | None = None
    """Contacts from below at ``start``, if the body stands on other bodies, on a solid or on uneven ground of a world;
    None if it stands on its own ground."""

    def __repr__(self) -> str:
        fibres = f", {self.muscles.fibre_count} muscle fibres" if self.muscles.fibre_count else ""
        size = f"{len(self.body.mesh.nodes)} nodes{fibres}, {self.body.height:.3g} m tall"
        notes = "".join(f"\n  note: {note}" for note in self.notes)
        return f"{type(self).__name__}({self.cloud.count:,} Gaussians, {size}){notes}"

    def placed(self, cloud: GaussianCloud) -> GaussianCloud:
        """Transform another cloud of the same capture, such as its background, to the frame of ``start``."""
        return to_body_frame(cloud, self.frame)

    @checked_method
    def moved(self, at: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0), heading: Finite = 0.0) -> Self:
        """Return the same body at rest elsewhere: turned about the vertical axis of the frame by ``heading`` degrees,
        counter-clockwise seen from above, then moved by ``at``, m. If both are zero, the object itself is returned."""
        turn = Rotation.from_rotvec(np.radians(heading) * GROUND.normal).as_matrix()
        shift = np.asarray(at, float)
        if heading == 0.0 and not shift.any():
            return self
        return self._moved(turn, shift)

    def with_friction(self, friction: float) -> Self:
        """Return the same body at rest on ground with another Coulomb coefficient.

        Raises ``ArgumentError`` for a coefficient outside ``FRICTION_RANGE``.
        """
        old = self.stepper
        geometry, device = replace(old.geometry, friction=checked_friction(friction)), str(old.body.assembly.device)
        stepper = LocomotionStepper(old.body, old.muscles, geometry, settings=old.settings, device=device)
        return replace(self, stepper=stepper, start=self.placement.applied_to(settle(stepper)))

    def _moved(self, turn: np.ndarray, shift: np.ndarray) -> Self:
        """Return the body after the rotation ``turn`` (3, 3) and the translation ``shift`` (3,) m."""
        axes, frame = turn @ self.frame.axes, self.frame
        return replace(
            self,
            frame=BodyFrame(axes, frame.origin - shift @ axes / frame.scale, frame.scale),
            start=Placement(turn, shift).applied_to(self.start),
            placement=self.placement.then(turn, shift),
        )

    def contact_points(self) -> np.ndarray:
        """Return the contact points (P, 3) m at ``start``."""
        geometry = self.geometry
        nodes = self.start.positions[geometry.mesh.tets[geometry.tet_from_point]]
        return np.einsum("pw,pwi->pi", geometry.weights, nodes)

    @property
    def body(self) -> SoftBody:
        """The soft body."""
        return self.stepper.body

    @property
    def mesh(self) -> TetMesh:
        """Tetrahedra around the Gaussians, in their rest shape."""
        return self.stepper.body.mesh

    @property
    def muscles(self) -> MuscleSet:
        """The muscles of the body."""
        return self.stepper.muscles

    @property
    def geometry(self) -> ContactGeometry:
        """Contact points, planes and friction coefficient."""
        return self.stepper.geometry


def points_at_rest(geometry: ContactGeometry) -> np.ndarray:
    """Return the contact points (P, 3) m of ``geometry`` in the rest shape."""
    mesh = geometry.mesh
    return np.einsum("pw,pwi->pi", geometry.weights, mesh.nodes[mesh.tets[geometry.tet_from_point]])


def checked_friction(friction: float) -> float:
    """Return the Coulomb coefficient ``friction``. Raises ``ArgumentError`` outside ``FRICTION_RANGE``."""
    if friction not in FRICTION_RANGE:
        raise ArgumentError("friction", f"give {FRICTION_RANGE.described('a number')}", value=friction)
    return friction
