"""Contact shadow of the animated object, and studio floor."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from egs_warp.geometry.camera import Camera, camera_rays
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.render.backdrop import captured_scene, plain_colour, studio_floor
from egs_warp.render.compositing import RenderedImage
from egs_warp.render.rasteriser import render_gaussians
from egs_warp.render.shadow import ContactShadow, shadow_blur_radius
from tests.support.scenes import FLOOR, ball_on_floor

SIDE = 120


def camera() -> Camera:
    return Camera.look_at(np.array([0.0, -4.0, 2.5]), np.zeros(3), np.eye(3)[2], width=SIDE, height=SIDE)


def placed(source: GaussianCloud, means: np.ndarray) -> GaussianCloud:
    fields = ("rotations", "log_scales", "opacity_logits", "sh")
    return GaussianCloud.from_numpy(means, *(getattr(source, name).numpy() for name in fields))


def parts() -> tuple[GaussianCloud, GaussianCloud]:
    """Return a flattened ball and the floor under it."""
    cloud, truth = ball_on_floor()
    ball = cloud.subset(truth)
    return placed(ball, ball.means.numpy() * [1.0, 1.0, 0.1]), cloud.subset(~truth)


def over_scene(scene: GaussianCloud, body: GaussianCloud, *, shadow: bool) -> np.ndarray:
    behind = captured_scene(
        scene,
        camera(),
        FLOOR,
        centre=np.zeros(3),
        reach=2.0,
        blur_radius=shadow_blur_radius(body),
        height=1.0,
        shadow=shadow,
    )
    return behind.background(body).numpy()


def test_a_scene_ends_in_the_grey_that_the_page_shows_there():
    body, scene = parts()
    few = scene.subset(np.arange(scene.count) < 1)
    picture = np.rint(255.0 * over_scene(few, body, shadow=False)).astype(int)
    # The BACKGROUND of the page (egs_warp/web/client/src/ground.ts).
    assert (np.median(picture.reshape(-1, 3), axis=0) == [0xB9, 0xBE, 0xC6]).all()


def on_ground(
    body: GaussianCloud, plane: Plane = FLOOR, centre: np.ndarray | None = None, *, height: float = 1.0
) -> ContactShadow:
    where = {"centre": np.zeros(3) if centre is None else centre, "reach": 2.0}
    return ContactShadow(
        camera(), plane, **where, device=body.device, blur_radius=shadow_blur_radius(body), height=height
    )


def square(values: Any) -> np.ndarray:
    return values.numpy().reshape(SIDE, SIDE, -1).squeeze()


def test_the_shadow_falls_on_the_visible_floor() -> None:
    """The image is darker under the body, and unchanged elsewhere and on surfaces in front of the floor. A higher body
    has a paler shadow."""
    body, floor = parts()
    bare, dark = (over_scene(floor, body, shadow=shadow) for shadow in (False, True))
    ground = on_ground(body)
    away, hit = np.linalg.norm(square(ground.flat), axis=-1), square(ground.depth) > 0.0
    under, far = hit & (away < 0.2), hit & (away > 1.2)
    assert dark[under].mean() < 0.75 * bare[under].mean()
    np.testing.assert_array_equal(dark[far], bare[far])
    behind = plain_colour(ground, (1.0, 1.0, 1.0))
    lifted = behind.shadow_opacity(placed(body, body.means.numpy() + [0.0, 0.0, 0.4])).numpy()
    assert 0.0 < lifted.max() < behind.shadow_opacity(body).numpy().max() <= 0.75
    # A wall in front of the floor gets no shadow.
    wall = placed(floor, floor.means.numpy()[:, [0, 2, 1]] + [0.0, -1.2, 1.0])
    plain, shaded = (over_scene(wall, body, shadow=shadow) for shadow in (False, True))
    np.testing.assert_allclose(shaded, plain, atol=0.02)


def test_the_shadow_on_an_uneven_floor_has_no_edge() -> None:
    """If half of the floor is above the fitted plane by 3 % of the shadow's reach, as on cloth, it receives nearly the
    same shadow. A much higher terrace receives little shadow, which still does not end within one pixel."""
    body, flat = parts()
    darkness = []
    for step in (0.0, 0.06, 0.4):
        floor = placed(flat, flat.means.numpy() + np.outer(flat.means.numpy()[:, 0] > 0.0, [0.0, 0.0, step]))
        bare, dark = (over_scene(floor, body, shadow=shadow) for shadow in (False, True))
        darkness.append(1.0 - dark.mean(axis=2) / np.maximum(bare.mean(axis=2), 1e-3))
    even, uneven, terrace = darkness
    right = np.s_[:, 62:]
    assert uneven[right].sum() > 0.8 * even[right].sum()
    assert terrace[right].sum() < 0.3 * even[right].sum()
    assert np.abs(np.diff(terrace, axis=1)).max() < 0.6 * even.max()


def blurred(values: np.ndarray, sigma: float) -> np.ndarray:
    """Return ``values`` blurred by a kernel that reaches four standard deviations."""
    size = 2 * int(np.ceil(4.0 * sigma)) + 1
    return cv2.GaussianBlur(values, (size, size), sigma)


def darkness(body: GaussianCloud, plane: Plane, centre: np.ndarray, reach: float, height: float) -> np.ndarray:
    """Return the shadow computed by an independent reference, from a histogram of the body, OpenCV's blur, and the ray
    of each pixel."""
    means, scales = body.means.numpy(), np.sort(np.exp(body.log_scales.numpy()), axis=1)
    texel, tangents, passing = 2.0 * reach / 192, np.stack(plane.tangents()), np.ones((192, 192))
    hidden = body.opacities() * 2.0 * np.pi * scales[:, 1] * scales[:, 2] / texel**2
    flat, above = (means - centre) @ tangents.T / texel + 96.0, np.maximum(plane.heights(means), 0.0)
    for low, high, blur in ((0.0, 0.06, 0.02), (0.06, 0.3, 0.065), (0.3, 2.0, 0.16)):
        chosen = (above >= low * height) & (above < high * height)
        counts, *_ = np.histogram2d(
            flat[chosen, 1], flat[chosen, 0], bins=192, range=((0, 192), (0, 192)), weights=hidden[chosen]
        )
        covered = 1.0 - np.exp(-blurred(counts, max(float(np.median(scales[:, 1])) / texel, 0.6)))
        passing *= 1.0 - blurred(covered, max(blur * height / texel, 0.6)) * (0.6 - 2.5 * blur)
    rays = camera_rays(camera())
    depth = -plane.heights(camera().centre) / (rays @ plane.normal)
    along = (camera().centre + depth[..., None] * rays - centre) @ tangents.T
    fade = np.clip(1.6 - 1.6 * np.linalg.norm(along, axis=-1) / reach, 0.0, 1.0) * (depth > 0.0)
    texels = (along / texel + 96.0 - 0.5).astype(np.float32)
    seen = cv2.remap((1.0 - passing).astype(np.float32), texels[..., 0], texels[..., 1], cv2.INTER_LINEAR)
    return seen * fade


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_the_shadow_equals_the_reference(tilt: float, device: str) -> None:
    """The shadow equals the reference on level and tilted ground, for bodies with different heights and sizes of
    Gaussians, fully or partly visible."""
    plane = Plane(np.array([np.sin(tilt), 0.0, np.cos(tilt)]), 0.1)
    random, (ball, _) = np.random.default_rng(3), parts()
    body = GaussianCloud.from_numpy(
        ball.means.numpy() * [1.0, 1.0, 12.0] + [0.2, 0.1, 0.0],
        ball.rotations.numpy(),
        random.uniform(-5.0, -2.0, ball.log_scales.shape + (3,)),
        random.normal(0.0, 3.0, ball.count),
        ball.sh.numpy(),
        device=device,
    )
    centre = np.array([0.1, -0.2, 0.0])
    ground = on_ground(body, plane, centre, height=0.7)
    found = ground.cover(body, ground.strengths())
    expected = darkness(body, plane, centre, 2.0, 0.7)
    assert expected.max() > 0.3
    np.testing.assert_allclose(square(found), expected, atol=0.01)
    assert np.abs(square(found) - expected).mean() < 1e-4


@pytest.mark.parametrize("step", [0.0, 0.4])
def test_a_shadow_is_as_sharp_in_a_long_motion_as_in_a_short_one(step: float) -> None:
    """A map that moves with the body gives the same shadow as the map of a small disc around the body, also when the
    body is not at the centre of the image. A single map of the whole disc does not."""
    ball, _ = parts()
    place = np.array([step, 0.25 * step, 0.0])
    body = placed(ball, ball.means.numpy() + place)
    options = {"device": body.device, "blur_radius": shadow_blur_radius(body), "height": 1.0}
    short = ContactShadow(camera(), FLOOR, centre=place, reach=2.0, **options)
    # The centre is a whole number of texels away from the body, so that the texels of both maps coincide.
    far = place - 300.0 * (4.0 / 192.0) * np.array([1.0, 0.0, 0.0])
    moving, fixed = (
        ContactShadow(camera(), FLOOR, centre=far, reach=30.0, body_reach=reach, **options) for reach in (2.0, None)
    )
    covers = [square(one.cover(body, one.strengths(), place)) for one in (short, moving, fixed)]
    inside = np.linalg.norm(square(short.flat), axis=-1) < 0.7
    expected, found, coarse = (cover[inside] for cover in covers)
    assert expected.max() > 0.3
    np.testing.assert_allclose(found, expected, atol=2e-3)
    assert np.abs(coarse - expected).max() > 0.1


def test_a_floor_has_lines_and_turns_into_the_sky_without_an_edge(device: str) -> None:
    """The fine lines are one cell apart; without a shadow, a body does not change the floor."""
    body, _ = parts()
    body = moved_to(body, device)
    low = Camera.look_at(np.array([0.0, -4.0, 0.8]), np.array([0.0, 0.0, 0.8]), np.eye(3)[2], width=SIDE, height=SIDE)
    ground = ContactShadow(low, FLOOR, centre=np.zeros(3), reach=2.0, device=body.device)
    picture = studio_floor(ground, cell=0.5, shadow=False).background(body).numpy()
    depth, flat, pixel = square(ground.depth), square(ground.flat), square(ground.pixel)
    assert (depth[: SIDE // 2] == 0.0).all() and (depth[SIDE // 2 :] > 0.0).all()
    across = np.abs((flat / 0.5 + 0.5) % 1.0 - 0.5).min(axis=-1) * 0.5 / pixel
    near = (depth > 0.0) & (depth < 5.0)
    assert picture[near & (across < 0.05)].mean() < picture[near & (across > 1.3)].mean() - 0.008
    assert np.abs(np.diff(picture[SIDE // 2 - 3 : SIDE // 2 + 3], axis=0)).max() < 0.01


def moved_to(cloud: GaussianCloud, device: str) -> GaussianCloud:
    fields = ("means", "rotations", "log_scales", "opacity_logits", "sh")
    return GaussianCloud.from_numpy(*(getattr(cloud, name).numpy() for name in fields), device=device)


def test_the_floor_hides_what_lies_below_it(device: str) -> None:
    """A Gaussian above the floor is visible, one below the floor is not, and one that crosses the floor is cut there.
    From below, and without a floor, all are visible."""
    body = parts()[0].subset(np.array([0]))
    ray = camera_rays(camera())[SIDE // 2, SIDE // 2]
    hit = 2.5 / -ray[2]

    def alpha(depth: float, view: Camera, *, bounded: bool) -> np.ndarray:
        ball = GaussianCloud.from_numpy(
            (camera().centre + depth * ray)[None],
            body.rotations.numpy(),
            np.full((1, 3), -2.5),
            np.full(1, 4.0),
            body.sh.numpy(),
            device=device,
        )
        ground = ContactShadow(view, FLOOR, centre=np.zeros(3), reach=2.0, device=ball.device)
        floor = studio_floor(ground, cell=0.5).floor_depth
        return render_gaussians(ball, view, max_depth=floor if bounded else None).alpha.numpy()

    middle = SIDE // 2
    assert alpha(hit - 0.3, camera(), bounded=True)[middle, middle] > 0.9
    assert alpha(hit + 0.8, camera(), bounded=True).max() == 0.0
    assert alpha(hit + 0.8, camera(), bounded=False)[middle, middle] > 0.9
    half, whole = (alpha(hit, camera(), bounded=bounded) for bounded in (True, False))
    np.testing.assert_array_equal(half[: middle - 1], whole[: middle - 1])
    assert half[middle + 1 :].max() == 0.0 < whole[middle + 1 :].max()
    below = Camera.look_at(np.array([0.0, -4.0, -2.5]), np.zeros(3), np.eye(3)[2], width=SIDE, height=SIDE)
    np.testing.assert_array_equal(alpha(hit, below, bounded=True), alpha(hit, below, bounded=False))


def test_quantisation_equals_numpy() -> None:
    """The quantisation equals that by NumPy's clip and rint."""
    import warp as wp

    colour = np.linspace(-0.2, 1.2, 3 * 7 * 511, dtype=np.float32).reshape(7, 511, 3)
    colour.reshape(-1)[:4] = np.array([0.5, 1.5, 2.5, 3.5], np.float32) / np.float32(255.0)
    image = RenderedImage(wp.array(colour, dtype=wp.vec3), wp.zeros(1, dtype=float), wp.zeros(1, dtype=float))
    expected = np.rint(np.clip(colour, 0.0, 1.0) * np.float32(255.0)).astype(np.uint8)
    np.testing.assert_array_equal(image.colour_srgb8(), expected)
