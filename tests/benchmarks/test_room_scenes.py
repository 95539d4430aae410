"""Procedural rooms: points sampled on their solids, and annotations that agree with the capture."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest

from egs_warp.geometry.gaussians import ARRAYS
from tests.support.scripts import BENCHMARKS, module_of


@pytest.fixture
def scenes(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return module_of("room_scenes")


def test_samples_are_even_on_the_surface(scenes: ModuleType) -> None:
    """Points of an ellipsoid satisfy its equation, and their normals are along its gradient. The numbers of points in
    the middle part of an ellipsoid and on each pair of faces of a box are proportional to the area."""
    random, half = np.random.default_rng(0), np.array([0.2, 0.3, 1.0])
    one = scenes.solids.ellipsoid((1, 2, 3), half, (0.5, 0.5, 0.5), tilt=40.0)
    samples = one.samples(0.03, random)
    local, normals = (samples.points - one.centre) @ one.turn, samples.normals @ one.turn
    np.testing.assert_allclose(((local / half) ** 2).sum(axis=1), 1.0, atol=1e-9)
    gradient = local / half**2
    np.testing.assert_allclose(normals, gradient / np.linalg.norm(gradient, axis=1, keepdims=True), atol=1e-9)
    # Reference: the area of a spheroid up to z is 2 pi a times the integral of sqrt(1 - (1 - a^2) z^2).
    assert (np.abs(local[:, 2]) < 0.5).mean() == pytest.approx(0.4798 / 0.8056, abs=0.02)
    assert len(local) == pytest.approx(4.0 * np.pi * 0.25 * 0.8056 / 0.03**2, rel=0.02)
    assert not one.contains(samples.points + 1e-6 * samples.normals).any()
    assert one.contains(samples.points - 1e-6 * samples.normals).all()
    faces = scenes.solids.box((0, 0, 0), (1, 1, 0.5), (0.5, 0.5, 0.5)).samples(0.05, random)
    assert (np.abs(faces.normals[:, 2]) > 0.5).mean() == pytest.approx(0.5, abs=0.02)


def test_there_are_twenty_rooms(scenes: ModuleType) -> None:
    """There are layouts of at least 20 rooms; together they contain all toys, all kinds of support and all kinds of
    neighbours."""
    layouts = scenes.SCENES.values()
    assert len(layouts) >= 20 and {layout.toy for layout in layouts} == set(scenes.solids.TOYS)
    assert {"duvet", "floor", "carpet", "grass", "table", "chair", "sofa", "shelf"} == {
        layout.support for layout in layouts
    }
    assert {"wall", "wardrobe", "toys", "pillow", "table"} == {name for layout in layouts for name in layout.neighbours}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bear_duvet_wall_wardrobe", "dog_grass_toys"])
def test_a_room_and_its_truth(scenes: ModuleType, name: str) -> None:
    """Equal arguments give equal bits, and another seed gives another scene. The labelled Gaussians are centred within
    a quarter of the size of every annotated photo; masks of object and occluders do not overlap; the cameras are
    upright."""
    scene, again = (scenes.build_scene(name, density=0.3, device="cpu") for _ in range(2))
    for array in ARRAYS:
        np.testing.assert_array_equal(getattr(scene.cloud, array).numpy(), getattr(again.cloud, array).numpy())
    other = scenes.build_scene(name, seed=1, density=0.3, device="cpu")
    assert other.cloud.count != scene.cloud.count
    assert 0.05 < scene.is_object.mean() < 0.4
    middle = scene.cloud.means.numpy()[scene.is_object].mean(axis=0)
    for view in scene.drawn.views:
        x, y, z = view.camera.rotation @ middle + view.camera.translation
        u, v = view.camera.cx + view.camera.fx * x / z, view.camera.cy + view.camera.fy * y / z
        assert abs(u / view.camera.width - 0.5) < 0.25 and abs(v / view.camera.height - 0.5) < 0.25
        assert 0.01 < view.mask.mean() < 0.5 and view.hidden is not None and not (view.mask & view.hidden).any()
    rights = np.array([camera.rotation[0] for camera in scene.cameras])
    spread = np.linalg.eigvalsh(rights.T @ rights)
    assert spread[0] < 0.1 * spread[1]
