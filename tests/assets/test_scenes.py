"""Built-in objects and scenes."""

from __future__ import annotations

import hashlib
import subprocess
import sys

import numpy as np
import pytest

from egs_warp.assets import BUILT_IN_SCENES, SQUARE, BuiltInObject, figurine, pawn, scene, stool
from egs_warp.assets.surface import SurfaceSamples, bake_light, quaternions_from_normals, sh_from_colour
from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.meshing.cage import build_cage

_OBJECTS = (pawn, stool, figurine)


def _digest(cloud: GaussianCloud) -> str:
    arrays = (cloud.means, cloud.rotations, cloud.log_scales, cloud.opacity_logits, cloud.sh)
    return hashlib.sha256(b"".join(array.numpy().tobytes() for array in arrays)).hexdigest()


def _third_axes(cloud: GaussianCloud) -> np.ndarray:
    """(n, 3) direction of each Gaussian's third axis."""
    w, x, y, z = cloud.rotations.numpy().T
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)


@pytest.mark.parametrize("make", _OBJECTS)
def test_object_stands_on_its_plane(make, device: str) -> None:
    """One unit tall, SH with a view-dependent part, flat splats, a base that straddles the plane by a little."""
    thing: BuiltInObject = make(device=device)
    cloud = thing.cloud
    heights, opacities = thing.plane.heights(cloud.means.numpy()), cloud.opacities()
    assert 15_000 <= cloud.count <= 30_000
    assert heights.max() == pytest.approx(1.0, abs=0.02)
    assert heights.min() > -0.005
    assert 0.0 < opacities[heights < 0].sum() / opacities.sum() < 0.01
    assert cloud.sh_degree == 3
    assert np.abs(cloud.sh.numpy()[:, 1:]).max() > 0.05
    scales = np.exp(np.sort(cloud.log_scales.numpy(), axis=1))
    assert np.median(scales[:, 0] / scales[:, 1]) < 0.35
    # Three-sigma reach through the plane, as in a capture.
    reach = (
        3.0
        * np.exp(cloud.log_scales.numpy()[:, :2]).max(axis=1)
        * np.sqrt(np.clip(1 - _third_axes(cloud)[:, 2] ** 2, 0, 1))
    )
    assert np.sum((heights > 0) & (heights < reach)) > 100


@pytest.mark.parametrize("make", _OBJECTS)
def test_object_has_a_cage(make) -> None:
    """Every built-in object gets a cage that keeps all promises."""
    thing: BuiltInObject = make()
    cage = build_cage(thing.cloud, thing.plane)
    assert cage.enclosed_opacity_mass >= 0.999
    assert cage.min_dihedral_degrees >= 8.0
    assert 300 <= len(cage.mesh.nodes) <= 1500


def test_stool_stands_on_four_feet() -> None:
    """The cage of the stool touches the floor in the four quadrants and nowhere between."""
    thing = stool()
    feet = build_cage(thing.cloud, thing.plane).mesh.nodes
    feet = feet[np.abs(feet[:, 2]) < 1e-9]
    for x in (-1, 1):
        for y in (-1, 1):
            assert np.sum((feet[:, 0] * x > 0.15) & (feet[:, 1] * y > 0.15)) >= 4
    assert not np.any(np.abs(feet[:, :2]).min(axis=1) < 0.12)


def test_same_bits_in_another_process() -> None:
    """The pawn is the same in every process, and another seed gives another one."""
    program = (
        "import sys; sys.path.insert(0, 'tests'); from test_scenes import _digest, pawn; print(_digest(pawn().cloud))"
    )
    other = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert _digest(pawn().cloud) in other.stdout
    assert _digest(pawn(seed=1).cloud) not in other.stdout


def test_pawn_normals_point_outwards() -> None:
    """The splats of the head lie flat on it."""
    cloud = pawn().cloud
    offset = cloud.means.numpy() - [0.0, 0.0, 0.826]
    head = cloud.means.numpy()[:, 2] > 0.75
    outwards = offset[head] / np.linalg.norm(offset[head], axis=1, keepdims=True)
    assert np.min(np.sum(outwards * _third_axes(cloud)[head], axis=1)) > 0.97


@pytest.mark.parametrize("name", BUILT_IN_SCENES)
def test_scene(name: str) -> None:
    """The floor is complete, also under the object; the camera sees the object; the parts add up."""
    made = scene(name)
    whole, is_object = made.whole()
    assert whole.count == made.object.count + made.background.count == len(is_object)
    assert np.array_equal(whole.means.numpy()[is_object], made.object.means.numpy())
    floor = made.background.means.numpy()
    floor = floor[np.abs(made.plane.heights(floor)) < 0.02][:, :2]
    standing = made.object.means.numpy()
    standing = standing[standing[:, 2] < 0.05][::25, :2]
    gaps = np.linalg.norm(standing[:, None] - floor[None], axis=2).min(axis=1)
    assert gaps.max() < 0.06
    camera = made.camera(width=200, height=200)
    seen = made.object.means.numpy() @ camera.rotation.T + camera.translation
    pixels = seen[:, :2] / seen[:, 2:] * camera.fx + 100.0
    assert np.all((pixels > 0) & (pixels < 200)) and seen[:, 2].min() > camera.near


def test_board_squares() -> None:
    """The pawn stands in the middle of a dark square; the next one along +x is light."""
    board = scene("pawn").background
    means, colour = board.means.numpy(), board.sh.numpy()[:, 0].mean(axis=1)

    def tone(x: float, y: float) -> float:
        return float(colour[np.all(np.abs(means[:, :2] - [x, y]) < 0.3 * SQUARE, axis=1)].mean())

    assert tone(0, 0) < tone(SQUARE, 0) - 0.3
    assert tone(0, SQUARE) > tone(0, 0) + 0.3
    assert tone(5 * SQUARE, 0) > tone(4 * SQUARE, 0) + 0.3


def test_unknown_scene() -> None:
    """The names are given."""
    with pytest.raises(UserError, match="scene 'castle' is unknown; built in are pawn, stool, figurine"):
        scene("castle")


def test_baked_light_against_closed_forms(device: str) -> None:
    """A disc of radius r overhead at height h hides the share r^2 / (r^2 + h^2) of a level point's sky."""
    angle = np.linspace(0.0, 2.0 * np.pi, 129)[:-1]
    radius, height = 0.5, 0.8
    rim = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(128, height)])
    vertices = np.concatenate([rim, [[0.0, 0.0, height]]])
    faces = np.array([[k, (k + 1) % 128, 128] for k in range(128)])
    points = np.array([[0.0, 0.0, 0.0], [50.0, 0.0, 0.0]])
    samples = SurfaceSamples(points, np.tile([0.0, 0.0, 1.0], (2, 1)), 0.1)
    light = bake_light(
        samples, vertices, faces, up=np.array([0.0, 0.0, 1.0]), light_direction=np.array([0.0, 0.0, 1.0]), reach=5.0,
        device=device,
    )  # fmt: skip
    hidden = radius**2 / (radius**2 + (height - 0.09) ** 2)
    assert light.sky == pytest.approx([0.12 + 0.88 * (1.0 - hidden), 1.0], abs=0.04)
    assert light.key == pytest.approx([0.0, 1.0])


def test_sh_of_a_highlight() -> None:
    """Seen along the lobe the highlight adds its strength to the colour; from behind next to nothing."""
    direction = np.array([[0.48, -0.6, 0.64]])
    sh = sh_from_colour(np.full((1, 3), 0.4), direction, np.array([0.2]), lobe_colour=(1.0, 1.0, 1.0))
    from egs_warp.geometry.camera import Camera
    from egs_warp.render import render_gaussians

    cloud = GaussianCloud.from_numpy(
        np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]]), np.full((1, 3), -1.0), np.array([16.0]), sh
    )

    def seen_from(eye: np.ndarray) -> float:
        camera = Camera.look_at(eye, np.zeros(3), np.array([0.0, 1.0, 0.0]), width=65, height=65)
        return float(render_gaussians(cloud, camera).colour.numpy().reshape(65, 65, 3)[32, 32].mean())

    # The renderer caps alpha at 0.99 over white.
    assert seen_from(10.0 * direction[0]) == pytest.approx(0.99 * 0.6 + 0.01, abs=0.01)
    assert seen_from(-10.0 * direction[0]) == pytest.approx(0.99 * 0.4 + 0.01, abs=0.02)


def test_quaternions_from_normals() -> None:
    """The third axis is the normal for any direction, straight down included."""
    normals = np.random.default_rng(0).normal(size=(50, 3))
    normals = np.concatenate([normals / np.linalg.norm(normals, axis=1, keepdims=True), [[0, 0, -1.0], [0, 0, 1.0]]])
    w, x, y, z = quaternions_from_normals(normals, np.linspace(0, 6, 52)).T
    third = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    assert np.allclose(third, normals, atol=1e-12)
