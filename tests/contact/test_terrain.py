"""Terrain of solids: heights of their tops, and one-line errors of a terrain file. Uneven ground: gaps and frames
compared with references, and a body that comes to rest on waves.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from egs_warp.assets import pawn
from egs_warp.contact.detection import ContactDetector, ContactGeometry, contact_geometry
from egs_warp.contact.terrain import Solid, read_terrain, step, surface_above
from egs_warp.deformation.embedding import embed_points
from egs_warp.errors import UserError
from egs_warp.fem.body import BodyState
from egs_warp.geometry.plane import Plane
from egs_warp.locomotion.audit import audit
from egs_warp.locomotion.recorder import Recorder
from egs_warp.locomotion.stepper import LocomotionStepper, WarmStart
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.pipelines.creature import CreatureOptions, make_creature
from egs_warp.pipelines.report import AUDIT_LIMITS
from tests.support.clouds import surface_cloud
from tests.support.creatures import coarse_creature
from tests.support.meshes import block_mesh
from tests.support.stances import DT, FLOOR, FORWARD
from tests.support.waves import wavy_ground

UP = np.array([0.0, 0.0, 1.0])


def test_tops_of_a_step_a_ramp_a_wall_and_a_box() -> None:
    stair = step(FLOOR, np.array([0.5, 0.0, 0.0]), np.array([2.0, 0.0, 0.0]), 0.2)
    ramp = Solid((Plane.from_coefficients(-np.tan(np.radians(10.0)), 0.0, 1.0, 0.0),))
    wall = Solid((Plane.from_coefficients(0.0, -1.0, 0.0, 1.0),))
    box = Solid((*stair.faces, Plane.from_coefficients(1.0, 0.0, 0.0, -2.0)))
    at = np.array([0.7, 0.3, 0.1])
    assert stair.distance_along(at, UP) == pytest.approx(0.1)
    assert stair.distance_along(at - [0.3, 0.0, 0.0], UP) == -np.inf
    assert ramp.distance_along(at, UP) == pytest.approx(0.7 * np.tan(np.radians(10.0)) - 0.1)
    assert wall.distance_along(at, UP) == -np.inf
    assert box.distance_along(at, UP) == pytest.approx(0.1) and box.distance_along(at + [2.0, 0.0, 0.0], UP) == -np.inf
    assert surface_above((Solid((FLOOR,)), stair, ramp, wall), at, UP) == pytest.approx(0.1)
    assert surface_above((), at, UP) == -np.inf
    assert stair.scaled(2.0).distance_along(2.0 * at, UP) == pytest.approx(0.2)


def test_the_top_of_an_overhang() -> None:
    """The solid is bounded by the faces z = 2 x below and z = 1 above: a vertical line leaves it at z = 1 if x < 0.5,
    and misses it otherwise."""
    wedge = Solid((Plane.from_coefficients(0.0, 0.0, 1.0, -1.0), Plane.from_coefficients(2.0, 0.0, -1.0, 0.0)))
    for x, z in ((0.0, 0.0), (0.0, -3.0), (0.4, 0.1), (-2.0, -1.0)):
        assert wedge.distance_along(np.array([x, 0.0, z]), UP) == pytest.approx(1.0 - z)
    for x, z in ((0.6, 0.0), (1.0, 0.5), (4.0, -1.0)):
        assert wedge.distance_along(np.array([x, 0.0, z]), UP) == -np.inf


def test_a_terrain_file(tmp_path: Path) -> None:
    path = tmp_path / "t.json"
    path.write_text("[[[0, 0, 2, -0.4], [-1, 0, 0, 0.5]], [[0, 1, 0, 3]]]")
    stair, wall = read_terrain(path)
    assert stair.faces[0].offset == -0.2 and len(stair.faces) == 2 and len(wall.faces) == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[", "not JSON"),
        ("{}", "it contains {}; give a list of solids, each a list of faces [nx, ny, nz, d]"),
        ("[[]]", "solid 1: it contains []; give a list of faces, each four numbers [nx, ny, nz, d]"),
        ("[[[0, 0, 1]]]", "solid 1: it contains [0, 0, 1]; give a list of faces, each four numbers [nx, ny, nz, d]"),
        ('[[[0, 0, 1, "a"]]]', 'solid 1: it contains [0, 0, 1, "a"]; give a list of faces, each four numbers'),
        ("[[[0, 0, 1, 0]], [[0, 0, 0, 1]]]", "solid 2: plane 0,0,0,1: give four finite numbers"),
        (f"[[[0, 0, 1, {401 * '1'}]]]", "solid 1: plane 0,0,1,inf: give four finite numbers"),
        (f"[[[0, 0, 1, {5000 * '1'}]]]", "solid 1: plane 0,0,1,inf: give four finite numbers"),
        ("[[[1e300, 1e300, 1, 0]]]", "solid 1: plane 1e+300,1e+300,1,0: give four finite numbers"),
        (str([[[0, 0, 1, 0]]] * 65), "the solids have 65 faces, the limit is 64; simplify them"),
    ],
)
def test_mistakes_of_a_terrain_file(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "t.json"
    path.write_text(text)
    with pytest.raises(UserError) as error:
        read_terrain(path)
    assert str(error.value).startswith(str(path)) and message in str(error.value) and "\n" not in str(error.value)


def test_a_ground_steeper_than_45_degrees_is_refused() -> None:
    thing = pawn(device="cpu")
    with pytest.raises(UserError) as error:
        make_creature(thing.cloud, plane=thing.plane, options=CreatureOptions(gravity_up=np.array([1.0, 0.0, 0.5])))
    assert str(error.value) == (
        "gravity_up 1,0,0.5: it makes the ground a slope of 63 degrees; give a direction at most 45 degrees from"
        " the ground's normal 0,0,1"
    )


def test_a_solid_that_contains_the_body_is_named(tmp_path: Path) -> None:
    """The second floor's normal points down into the body."""
    thing = pawn(device="cpu")
    path = tmp_path / "t.json"
    path.write_text("[[[0, 1, 0, 9]], [[0, 0, 1, -3]]]")
    with pytest.raises(UserError) as error:
        make_creature(thing.cloud, plane=thing.plane, options=CreatureOptions(solids=read_terrain(path)))
    assert str(error.value) == (
        "solids: the body is inside solid 2, where n.x + d < 0 for every face [nx, ny, nz, d];"
        " change the signs of a face, or move the solid"
    )


WALL = Solid((Plane.from_coefficients(-1.0, 0.0, 0.0, 0.15),))


def test_the_kernel_equals_its_twin(device: str) -> None:
    """Eq. (8): gaps to the nearer one of wavy ground and a wall beside it, and contact frames, compared with plain
    NumPy."""
    mesh = block_mesh()
    field = wavy_ground(reach=0.3)
    cloud = surface_cloud(mesh, 400, lowest=0.04)
    wall = Solid((Plane.from_coefficients(-1.0, 0.0, 0.0, 0.25),))
    geometry = contact_geometry(cloud, mesh, (FLOOR,), field=field, solids=(wall,), device=device)
    detector = ContactDetector(geometry, device=device)
    random = np.random.default_rng(2)
    # Half of the points lie far outside the grid.
    x = 2.0 * mesh.nodes + 0.2 * random.standard_normal(mesh.nodes.shape) - [0.0, 0.0, 0.3]
    points = np.einsum("pw,pwi->pi", geometry.weights, x[mesh.tets[geometry.tet_from_point]])
    both = np.stack([field.gaps(points), wall.faces[0].heights(points)])
    gaps, faces = detector.gaps(x)
    assert np.abs(gaps - both.min(axis=0)).max() < 1e-12
    assert np.array_equal(faces, both.argmin(axis=0)) and set(faces) == {0, 1}
    contacts = detector.contact_set(np.arange(len(points)), x)
    on_ground = faces == 0
    assert np.array_equal(contacts.faces, faces)
    assert np.abs(contacts.axes[on_ground] - field.frames(points[on_ground])).max() < 1e-14
    assert np.allclose(contacts.axes[~on_ground, 0], [-1.0, 0.0, 0.0])


def test_contact_velocities_are_the_rate_of_the_gap(device: str) -> None:
    """For points on the ground, the normal contact velocities predict the gaps after a small displacement to second
    order."""
    mesh = block_mesh()
    field = wavy_ground()
    x = mesh.nodes.copy()
    x[:, 2] += field.ground_height(x)
    soles = embed_points(mesh, mesh.nodes[mesh.nodes[:, 2] == 0.0], device="cpu")
    geometry = ContactGeometry(mesh, (FLOOR,), 0.8, soles.tets.numpy(), soles.weights.numpy(), 0, 0.0, field=field)
    detector = ContactDetector(geometry, device=device)
    contacts = detector.contact_set(np.arange(len(geometry.weights)), x)
    # The tolerance is for the weights of the points, which are in single precision.
    assert np.abs(contacts.gaps).max() < 1e-6
    v = np.random.default_rng(3).standard_normal(x.shape)
    for dt in (1e-3, 1e-4):
        moved, _ = detector.gaps(x + dt * v)
        assert np.abs(contacts.end_gaps(dt, v) - moved).max() < 10.0 * dt**2


def test_arms_end_on_the_ground_and_bumps_between_them_are_detected() -> None:
    """Eq. (3): no point begins inside the ground. More points remain than on flat ground, and above bumps as wide as
    two cage edges no Gaussian mean is deeper than the deepest point."""
    mesh = block_mesh()
    field = wavy_ground(0.02, spacing=0.05)
    cloud = surface_cloud(mesh, 20000, lowest=0.03)
    geometry = contact_geometry(cloud, mesh, (FLOOR,), field=field, device="cpu")
    flat = contact_geometry(cloud, mesh, (FLOOR,), device="cpu")
    assert len(geometry.weights) > 1.2 * len(flat.weights) and geometry.excluded_count == 0
    detector = ContactDetector(geometry, device="cpu")
    assert detector.gaps(mesh.nodes)[0].min() > -1e-6
    means = cloud.means.numpy().astype(np.float64)
    for shift in np.linspace(0.0, 0.4, 9):
        down = np.array([shift, 0.5 * shift, -0.05])
        assert detector.gaps(mesh.nodes + down)[0].min() < field.gaps(means + down).min() + 1e-3


def test_the_highest_of_ground_and_solids_is_stood_on() -> None:
    field = wavy_ground()
    point = np.array([0.3, 0.2, 1.0])
    block = Solid((Plane(np.array([0.0, 0.0, 1.0]), -0.5), WALL.faces[0]))
    up = np.array([0.0, 0.0, 1.0])
    assert surface_above((field, block), point, up) == pytest.approx(-0.5)
    assert surface_above((field, block), point - [0.3, 0.0, 0.0], up) == pytest.approx(
        float(field.ground_height(point - [0.3, 0.0, 0.0])) - 1.0
    )


@cache
def drop() -> tuple[Trajectory, LocomotionStepper, int]:
    """Drop a squat block by 0.1 m onto waves, without muscle work, until it is at rest."""
    made = coarse_creature(block_mesh(4, 4, 3, size=(0.6, 0.6, 0.4)), forward=FORWARD, settle_first=False)
    body, muscles = made.stepper.body, made.stepper.muscles
    base = np.stack(np.meshgrid(*[np.linspace(-0.3, 0.3, 13)] * 2, [0.0]), axis=-1).reshape(-1, 3)
    soles = embed_points(body.mesh, base, device="cpu")
    field = wavy_ground(0.03)
    geometry = ContactGeometry(body.mesh, (FLOOR,), 0.8, soles.tets.numpy(), soles.weights.numpy(), 0, 0.0, field=field)
    stepper = LocomotionStepper(body, muscles, geometry, device="cpu")
    lift = 0.1 + float(field.ground_height(base).max())
    start = BodyState(body.mesh.nodes + [0.0, 0.0, lift], np.zeros_like(body.mesh.nodes))
    gaps, _ = stepper.detector.gaps(start.positions)
    recorder = Recorder(body, muscles, geometry, start, float(gaps.min()), drag=0.0)
    state, memory, unconverged = start, stepper.initial_memory(), 0
    for _ in range(210):
        report = stepper.step_with_activations(state, memory, memory.activations, DT)
        state, memory = report.state, WarmStart.from_report(report)
        recorder.add([report])
        unconverged += not report.converged
    return recorder.trajectory(), stepper, unconverged


def test_a_body_dropped_onto_waves_comes_to_rest_in_balance() -> None:
    """The body comes to rest on several slopes; forces carry the weight, and without slip their torque about the centre
    is zero."""
    t, stepper, _ = drop()
    speed = np.linalg.norm(t.velocities[-1], axis=1).max()
    assert speed < 2e-3 * np.sqrt(9.81)
    last = t.contact_step == len(t.dt) - 1
    assert np.ptp(t.contact_normal[last], axis=0).max() > 0.05
    force = t.contact_force[last]
    assert force.sum(axis=0) == pytest.approx([0.0, 0.0, stepper.body.weight], abs=2e-3 * stepper.body.weight)
    points = np.einsum("cw,cwi->ci", t.contact_weights[last], t.positions[-1][t.contact_nodes[last]])
    torque = np.cross(points - stepper.body.centre_of_mass(t.positions[-1]), force).sum(axis=0)
    assert np.abs(torque).max() < 2e-3 * stepper.body.weight


def test_the_drop_passes_the_audit() -> None:
    """All bounds of the audit hold, from the file alone: no point is deeper than 0.5 % of the height, and the energy
    balance closes."""
    t, _, unconverged = drop()
    found = audit(t, newton_unconverged=unconverged)
    for name, limit in AUDIT_LIMITS.items():
        assert getattr(found, name) <= limit, name
    assert found.penetration < 5e-3 and found.energy_residual < 1e-9


def test_the_audit_recomputes_the_ground() -> None:
    """The audit detects forces that do not agree with a lifted, lowered or shifted ground. It uses the normals of the
    ground instead of the stored ones."""
    t, _, _ = drop()
    lifted = replace(t, ground_coefficients=t.ground_coefficients + 0.02)
    assert audit(lifted).penetration > 0.015
    lowered = replace(t, ground_coefficients=t.ground_coefficients - 1e-3)
    assert audit(lowered).complementarity_gap > 1e-4
    moved = replace(t, ground_origin=t.ground_origin + [0.2, 0.0, 0.0])
    assert audit(moved).complementarity_gap > 1e-3 or audit(moved).cone_violation > 1e-3
    # The stored normals are ignored: forces are resolved along the normals of the ground.
    upright = replace(t, contact_normal=np.tile([0.0, 0.0, 1.0], (len(t.contact_normal), 1)))
    assert audit(upright).cone_violation == audit(t).cone_violation
