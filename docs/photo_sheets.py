"""Illustrations of the advice for photos and of typical failures, rendered from the built-in scenes.

python docs/photo_sheets.py --out out/photos writes taking.png, photos.png and object.png. Each failure is simulated,
not drawn.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from egs_warp.assets import scene
from egs_warp.assets.scene import Scene
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud, concatenate
from egs_warp.geometry.plane import Plane
from egs_warp.io.video import contact_sheet, write_png
from egs_warp.pipelines.locate_plane import locate_plane
from egs_warp.pipelines.pictures import plane_picture
from egs_warp.render import render_gaussians
from egs_warp.segmentation.object_spec import ObjectSpec

SIDE = 300
MIDDLE = np.array([0.0, 0.0, 0.4])
BACKDROP = (0.55, 0.75, 0.55)


def eye(degrees: float, elevation: float = 28.0, away: float = 3.2) -> np.ndarray:
    """Return the position (3,) of a photographer on a circle around the object."""
    a, e = np.radians([degrees, elevation])
    return MIDDLE + away * np.array([np.sin(a) * np.cos(e), -np.cos(a) * np.cos(e), np.sin(e)])


def camera(place: np.ndarray, fov: float = 38.0, target: np.ndarray = MIDDLE) -> Camera:
    """Return a camera at ``place`` that looks at ``target``, by default the object."""
    return Camera.look_at(place, target, np.array([0.0, 0.0, 1.0]), width=SIDE, height=SIDE, vertical_fov_degrees=fov)


def render(
    cloud: GaussianCloud, view: Camera, background: tuple[float, float, float] = (0.75, 0.78, 0.8)
) -> np.ndarray:
    """Return the render (SIDE, SIDE, 3) uint8."""
    return render_gaussians(cloud, view, background=background).colour_srgb8()


def positions_from_above(cloud: GaussianCloud, places: list[np.ndarray]) -> np.ndarray:
    """Render the scene from above with a dot at the position of each photo, lighter for higher ones."""
    above = camera(np.array([0.0, -3.2, 7.5]), 50.0)
    picture = np.ascontiguousarray(render(cloud, above))
    for place in places:
        x, y, z = above.rotation @ place + above.translation
        at = (round(above.cx + above.fx * x / z), round(above.cy + above.fy * y / z))
        cv2.circle(picture, at, 5, (255, 255, 255), -1, cv2.LINE_AA)
        cv2.circle(picture, at, 4, (230, 40, 60) if place[2] < 2.2 else (255, 170, 60), -1, cv2.LINE_AA)
    return picture


def blurred(picture: np.ndarray) -> np.ndarray:
    """Blur an image as a shaken camera does."""
    kernel = np.zeros((25, 25), np.float32)
    cv2.line(kernel, (2, 6), (22, 18), 1.0)
    return cv2.filter2D(picture, -1, kernel / kernel.sum())


def toned(picture: np.ndarray, gains: tuple[float, float, float]) -> np.ndarray:
    """Change exposure and white balance."""
    return np.clip(picture * np.array(gains), 0, 255).astype(np.uint8)


def moved(cloud: GaussianCloud, shift: np.ndarray) -> GaussianCloud:
    """Return ``cloud`` translated."""
    fields = (getattr(cloud, name).numpy() for name in ("rotations", "log_scales", "opacity_logits", "sh"))
    return GaussianCloud.from_numpy(cloud.means.numpy() + shift, *fields)


def foggy(cloud: GaussianCloud) -> GaussianCloud:
    """Imitate a capture of too few photos: few Gaussians, too large and too faint, some of them misplaced."""
    random = np.random.default_rng(0)
    sparse = cloud.subset(np.sort(random.choice(cloud.count, cloud.count // 9, replace=False)))
    means, scales = sparse.means.numpy(), sparse.log_scales.numpy()
    strays = random.random(sparse.count) < 0.05
    means = means + np.where(strays[:, None], random.normal(0.0, 0.6, means.shape), 0.0)
    rest = (sparse.rotations.numpy(), scales + 0.9, sparse.opacity_logits.numpy() - 1.5, sparse.sh.numpy())
    return GaussianCloud.from_numpy(means, *rest)


def on_haze(made: Scene, degrees: float = 8.0) -> tuple[GaussianCloud, Plane]:
    """Return the object on plain white ground, and the plane of the haze.

    Training on such ground puts wide Gaussians through the object's foot, in a plane that leans.
    """
    count, bands = 1000, made.object.sh.shape[1]
    leaning = Plane(np.array([np.sin(np.radians(degrees)), 0.0, np.cos(np.radians(degrees))]), -0.02)
    flat = np.random.default_rng(5).uniform(-2.0, 2.0, (count, 2)) @ np.stack(leaning.tangents())
    white = np.tile(1.4 * (np.arange(bands) == 0)[:, None], (count, 1, 3))
    # The quaternions (w, x, y, z) are those of a rotation about y.
    half = np.radians(degrees) / 2.0
    haze = GaussianCloud.from_numpy(
        flat - leaning.offset * leaning.normal,
        np.tile([np.cos(half), 0.0, np.sin(half), 0.0], (count, 1)),
        np.tile(np.log([0.16, 0.16, 0.004]), (count, 1)),
        np.full(count, 1.0),
        white,
    )
    return concatenate(made.object, haze), leaning


def taking(made: Scene) -> np.ndarray:
    """Illustrate ten pieces of advice for taking photos."""
    whole, _ = made.whole()
    round_once = [eye(d, e, a) for e, a in ((22.0, 3.4), (48.0, 3.2)) for d in range(0, 360, 18)]
    spin = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    on_the_spot = [eye(0.0, 22.0, 3.4) + 0.25 * np.array([np.cos(a), np.sin(a), 0.0]) for a in spin]
    good = render(whole, camera(eye(0.0)))
    shade = np.linspace(0.0, 1.0, SIDE)[None, :, None] + np.linspace(-0.4, 0.4, SIDE)[:, None, None] > 0.62
    turned_away = render(with_moved_object(made, np.array([0.35, 0.25, 0.0])), camera(eye(0.0)))
    pictures = [
        (positions_from_above(whole, round_once), "1 round it, from two heights"),
        (np.concatenate([good, render(whole, camera(eye(18.0)))], axis=1), "2 each shows most of the last"),
        (good, "3 it fills a third to a half"),
        (render(whole, camera(eye(0.0), 110.0)), "4 not: too small"),
        (render(whole, camera(eye(0.0), 17.0)), "5 not: no ground beside it"),
        (blurred(good), "6 not: shaken"),
        (np.concatenate([good, toned(good, (0.55, 0.6, 0.75))], axis=1), "7 better: one exposure"),
        (np.concatenate([good, turned_away], axis=1), "8 not: it was moved"),
        (np.where(shade, (0.45 * good).astype(np.uint8), good), "9 not: your own shadow"),
        (positions_from_above(whole, on_the_spot), "10 not: turning on the spot"),
    ]
    return sheet(pictures, 5)


def with_moved_object(made: Scene, shift: np.ndarray) -> GaussianCloud:
    """Return the scene with its object translated."""
    return replace(made, object=moved(made.object, shift)).whole()[0]


def photos(made: Scene) -> np.ndarray:
    """Illustrate failures of the training, between the photos and the capture."""
    whole, _ = made.whole()
    good = render(whole, camera(eye(0.0)))
    arcs = [eye(d, 22.0, 3.4) for d in (*range(-40, 41, 10), *range(150, 211, 10))]
    cut = good.copy()
    cut[int(0.55 * SIDE) :] = 128
    cropped = np.full_like(good, 255)
    cropped[40:260, 20:240] = good[60:280, 60:280]
    haze, leaning = on_haze(made)
    eyes = [camera(eye(degrees, elevation)) for elevation in (20.0, 45.0) for degrees in range(0, 360, 45)]
    laid = locate_plane(haze, ObjectSpec(point=np.array([0.0, 0.0, 0.6])), cameras=eyes).plane
    noise = np.random.default_rng(1).integers(170, 256, (SIDE // 10, SIDE // 10, 3)).astype(np.uint8)
    pictures = [
        (positions_from_above(whole, arcs), "a two groups"),
        (blurred(blurred(good)), "b nothing to match"),
        (
            np.concatenate([good, render(with_moved_object(made, np.array([0.35, 0.25, 0.0])), camera(eye(0.0)))], 1),
            "c moved",
        ),
        (cropped, "d cropped afterwards"),
        (cv2.resize(noise, (SIDE, SIDE), interpolation=cv2.INTER_NEAREST), "e no picture to us"),
        (cut, "f cut short"),
        (render(foggy(whole), camera(eye(70.0))), "g fog in new views"),
        (np.concatenate([good, toned(good, (0.5, 0.55, 0.7))], axis=1), "h exposures differ: found"),
        *(
            (grid(made.object, plane, camera(eye(-10.0, 14.0))), words)
            for plane, words in ((leaning, "i in haze it leans"), (laid, "i laid under it"))
        ),
    ]
    return sheet(pictures, 5)


def segmentation(made: Scene) -> np.ndarray:
    """Illustrate failures of the segmentation, between the capture and the object."""
    whole, object_mask = made.whole()
    heights, means = made.plane.heights(whole.means.numpy()), whole.means.numpy()
    view = camera(eye(-20.0))

    def alone(chosen: np.ndarray) -> np.ndarray:
        return render(whole.subset(chosen), view, BACKDROP)

    near = np.linalg.norm(means[:, :2], axis=1)
    foot = (heights < 0.02) & (near < 0.75)
    hole = render(whole.subset(~object_mask & ~((near < 0.3) & (heights < 0.02))), view)
    pictures = [
        (grid(whole, made.plane, view), "j the plane as it should lie"),
        (grid(whole, Plane(made.plane.normal, made.plane.offset - 0.3), view), "k it lies too high"),
        (alone(object_mask), "l the object as it should be"),
        (alone(object_mask & (heights < 0.62)), "m a part is missing"),
        (alone(object_mask & (heights > 0.12)), "n its foot is missing"),
        (alone(object_mask | foot), "o floor taken along"),
        (hole, "p the hole, not filled"),
        (
            render(
                with_moved_object(made, np.array([1.9, 0.0, 0.0])), camera(eye(-20.0), 60.0, np.array([0.7, 0.0, 0.3]))
            ),
            "q beyond the edge",
        ),
    ]
    return sheet(pictures, 4)


def grid(cloud: GaussianCloud, plane: Plane, view: Camera) -> np.ndarray:
    """Render ``plane`` as in plane.png, without the text."""
    picture = plane_picture(cloud, [plane], [view], centre=MIDDLE, size=1.3)
    return cv2.resize(picture[24:SIDE, 12 : SIDE - 12], (SIDE, SIDE), interpolation=cv2.INTER_AREA)


def sheet(pictures: list[tuple[np.ndarray, str]], columns: int) -> np.ndarray:
    """Arrange tiles of one size with captions; pairs are shown at half their size."""
    tiles = []
    for picture, _ in pictures:
        wide = picture.shape[1] > picture.shape[0]
        small = cv2.resize(picture, (SIDE, SIDE // 2), interpolation=cv2.INTER_AREA) if wide else picture
        tile = np.full((SIDE, SIDE, 3), 255, np.uint8)
        top = (SIDE - len(small)) // 2
        tile[top : top + len(small)] = small
        tiles.append(tile)
    return contact_sheet(tiles, columns, [words for _, words in pictures])


def main() -> None:
    """Write the sheets of illustrations."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    made = scene("figurine")
    for name, make in (("taking", taking), ("photos", photos), ("object", segmentation)):
        write_png(out / f"{name}.png", make(made))


if __name__ == "__main__":
    main()
