"""Shadow and shading of a moved toy in procedural rooms with a known light, compared with the truth.

The rooms of ``room_scenes.py`` are lit by a distant light of known direction and softness that casts shadows of all
solids. Every fifth room is overcast. The light is estimated from the labelled object and the rest of the capture
(``egs_warp.lighting``). Then the toy is turned by 70 degrees and lifted by a quarter of its height, and its shadow on
the ground and its colours are compared with the results of the known light. ``before`` is the result without an
estimated light, with a shadow straight below the object and the captured colours.

A point of the ground is in shadow if less than half of the light reaches it. Points in the shadow of other solids are
ignored, and so are rooms in which the whole shadow of the object lies within such shadows.

Aims: ``shadow_overlap`` (mean IoU of at least 0.6 over the lit rooms, and in none less than before), ``relit_psnr``
(mean PSNR of the object at least 1.5 dB above that without relighting), ``clear`` (a light is found in at least nine
tenths of the lit rooms, and no shadow is cast in an overcast one).
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.main_light import DISPLAY_GAMMA, MainLight
from egs_warp.geometry.plane import Plane
from egs_warp.lighting.estimate import estimate_light
from egs_warp.lighting.evidence import shadow_on
from egs_warp.lighting.relighting import Relighter
from egs_warp.render import render_gaussians
from harness import Row, Table, flags, report, timed
from room_scenes import SCENES, SyntheticScene, build_scene
from room_solids import SceneLight, Solid

TURN, LIFT = 70.0, 0.25
"""Rotation of the toy about the vertical axis (degrees), and its lift (heights of the toy)."""


def light_of_scene(number: int, seed: int, *, is_frontal: bool) -> SceneLight:
    """Return the light of the room ``number``; a frontal light comes from the photographer's side."""
    random = np.random.default_rng([seed, number, 7])
    low, high = (-150.0, -30.0) if is_frontal else (-180.0, 180.0)
    azimuth, elevation = np.radians([random.uniform(low, high), random.uniform(32.0, 62.0)])
    direction = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    key = 0.0 if number % 5 == 4 else float(random.uniform(0.5, 1.0))
    return SceneLight(direction, float(random.uniform(1.0, 10.0)), key)


def row_of(name: str, number: int, options: argparse.Namespace) -> tuple[Row, np.ndarray]:
    """Return the row of one room, and pictures of the turned toy: captured colours, relit, truth."""
    layout = SCENES[name]
    is_frontal = bool(layout.neighbours) or layout.support in ("chair", "sofa", "shelf")
    light = light_of_scene(number, options.seed, is_frontal=is_frontal)
    scene = build_scene(name, seed=options.seed, density=options.density, light=light, device=options.device)
    axes, frame = scene.frame.axes, scene.frame
    is_flat = layout.support not in ("duvet", "grass")
    plane = Plane(axes[2], -float(axes[2] @ frame.origin))
    ground = plane if is_flat else _height_field(scene)
    rest, background = scene.cloud.subset(scene.is_object), scene.cloud.subset(~scene.is_object)
    estimate, milliseconds = timed(estimate_light, rest, background, ground)
    estimated = estimate.light
    row: Row = {"scene": name, "is_lit": light.key > 0.0, "note": estimate.note, "seconds": 1e-3 * milliseconds}
    if estimated is not None:
        cosine = float(np.clip(axes @ estimated.direction @ light.direction, -1.0, 1.0))
        row |= {"degrees": float(np.degrees(np.arccos(cosine))), "shade": estimated.shade}
        row |= {"half_angle": estimated.half_angle, "true_half_angle": light.half_angle}
    size = float(np.quantile(plane.heights(rest.means.numpy()), 0.99)) * frame.scale
    turned, rotations = _turned(rest, scene, size)
    row |= _overlaps(
        scene, turned, plane, size, light, estimated if estimated is not None and estimated.shade else None
    )
    truth = _truth(rest, turned, scene, size, light)
    relit = Relighter(rest, estimated).relight(turned, rotations) if estimated is not None else turned
    errors, shown = [], []
    for view in scene.drawn.views[1::2]:
        pictures = [render_gaussians(one, view.camera, background=(0.0, 0.0, 0.0)) for one in (turned, relit, truth)]
        inside = pictures[2].alpha.numpy() > 0.5
        if not inside.any():
            continue
        before, after, exact = (np.clip(one.colour.numpy(), 0.0, 1.0) for one in pictures)
        errors.append([np.mean((one - exact)[inside] ** 2) for one in (before, after)])
        shown.append(np.concatenate([before, after, exact], axis=1))
    before, after = (-10.0 * np.log10(np.mean(errors, axis=0))).tolist()
    row |= {"psnr_before": before, "psnr": after}
    return row, np.rint(255.0 * _resized(shown[0])).astype(np.uint8)


def _resized(picture: np.ndarray) -> np.ndarray:
    import cv2

    return np.asarray(cv2.resize(picture, (720, 240), interpolation=cv2.INTER_AREA))


def _height_field(scene: SyntheticScene) -> HeightField:
    """Return the room's ground as a height field in the capture's frame."""
    nodes = np.arange(-3.0, 3.01, 0.1)
    flat = np.stack(np.meshgrid(nodes, nodes), axis=-1)
    heights = scene.relief(flat.reshape(-1, 2)).reshape(flat.shape[:2])
    field = HeightField.through(np.eye(3), np.array([-3.0, -3.0, 0.0]), 0.1, heights)
    frame = scene.frame
    back = replace(frame, axes=frame.axes.T, origin=-frame.scale * frame.axes @ frame.origin, scale=1.0 / frame.scale)
    return back.height_field(field)


def _turned(rest: GaussianCloud, scene: SyntheticScene, size: float) -> tuple[GaussianCloud, wp.array]:
    """Return the turned and lifted toy and the rotation (n,) vec4 of each Gaussian, both in the capture's frame."""
    axes = scene.frame.axes
    turn = Rotation.from_matrix(axes.T @ Rotation.from_euler("z", TURN, degrees=True).as_matrix() @ axes)
    place = scene.frame.points(rest.means.numpy())
    place = place @ Rotation.from_euler("z", TURN, degrees=True).as_matrix().T + [0.0, 0.0, LIFT * size]
    own = Rotation.from_quat(rest.rotations.numpy()[:, [1, 2, 3, 0]])
    moved = GaussianCloud.from_numpy(
        scene.frame.capture_points(place),
        (turn * own).as_quat()[:, [3, 0, 1, 2]],
        rest.log_scales.numpy(),
        rest.opacity_logits.numpy(),
        rest.sh.numpy(),
        device=str(rest.device),
    )
    quaternion = np.tile(turn.as_quat()[[3, 0, 1, 2]], (rest.count, 1)).astype(np.float32)
    return moved, wp.array(quaternion, dtype=wp.vec4, device=rest.device)


def _moved_solids(scene: SyntheticScene, size: float) -> list[Solid]:
    return [one.moved((0.0, 0.0, LIFT * size), TURN) for one in scene.solids[0]]


def _truth(
    rest: GaussianCloud, turned: GaussianCloud, scene: SyntheticScene, size: float, light: SceneLight
) -> GaussianCloud:
    """Return the turned toy with the colours that the light gives it."""
    toy, others = scene.solids
    levels = []
    for cloud, solids in ((rest, toy), (turned, _moved_solids(scene, size))):
        own = Rotation.from_quat(cloud.rotations.numpy()[:, [1, 2, 3, 0]]).as_matrix()
        normals = own[:, :, 2] @ scene.frame.axes.T
        levels.append(light.irradiance(scene.frame.points(cloud.means.numpy()), normals, [*solids, *others]))
    gain = (levels[1] / levels[0])[:, None] ** (1.0 / DISPLAY_GAMMA)
    colour = np.clip(gain * (0.5 + SH_BAND_0 * rest.sh.numpy()[:, 0]), 0.0, 1.0)
    sh = wp.array(((colour - 0.5) / SH_BAND_0)[:, None].astype(np.float32), dtype=wp.vec3, device=rest.device)
    return replace(turned, sh=sh)


def _overlaps(
    scene: SyntheticScene,
    turned: GaussianCloud,
    plane: Plane,
    size: float,
    light: SceneLight,
    estimated: MainLight | None,
) -> Row:
    """Return the overlaps (IoU) of two shadows with the true one: straight below the toy, and cast by the estimated
    light."""
    side = np.arange(-2.4, 2.41, 0.03)
    flat = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    points = np.column_stack([flat, scene.relief(flat)])
    others = scene.solids[1]
    # The furniture that supports the toy is a solid, too.
    outside = ~np.any([one.contains(points + [0.0, 0.0, 0.01]) for one in others], axis=0) if others else True
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    counted = (light.visible(points, normals, others) > 0.5) & outside
    points, normals = points[counted], normals[counted]
    if light.key == 0.0:
        return {}
    true = light.visible(points, normals, _moved_solids(scene, size)) < 0.5
    if not true.any():
        return {}
    in_capture = scene.frame.capture_points(points)
    centre, units = scene.frame.capture_points(np.zeros(3)), size / scene.frame.scale

    def overlap(one: MainLight | None) -> float:
        shadow = shadow_on(in_capture, turned, plane, centre, units, one)
        mask = shadow > 0.5 * (1.0 if one is not None else max(float(shadow.max()), 1e-6))
        return float((mask & true).sum() / max((mask | true).sum(), 1))

    before = overlap(None)
    known = MainLight(light.direction @ scene.frame.axes, light.half_angle, 1.0, np.eye(4))
    return {
        "iou_before": before,
        "iou": before if estimated is None else overlap(estimated),
        "iou_known_light": overlap(known),
    }


def aims_of(rows: Sequence[Row]) -> dict[str, bool]:
    """Return the aims, computed from the rows."""
    lit = [row for row in rows if row["is_lit"]]
    shadows = [row for row in lit if "iou" in row]
    gain = np.mean([row["psnr"] - row["psnr_before"] for row in lit])
    return {
        "shadow_overlap": bool(
            np.mean([row["iou"] for row in shadows]) >= 0.6 and all(row["iou"] >= row["iou_before"] for row in shadows)
        ),
        "relit_psnr": bool(gain >= 1.5),
        "clear": bool(
            sum("degrees" in row for row in lit) >= 0.9 * len(lit)
            and not any(row.get("shade", 0.0) for row in rows if not row["is_lit"])
        ),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = flags(
        __doc__,
        quick="every third room, with half of the Gaussians",
        device="cpu",
        seed="seed of the rooms and lights",
        plot="image of the turned toy: captured colours, relit, truth",
    )
    parser.add_argument("--only", nargs="*", metavar="ROOM", choices=SCENES, help="only these rooms")
    parser.add_argument("--density", type=float, help="factor of the number of Gaussians (1)")
    options = parser.parse_args(arguments)
    options.density = options.density or (0.5 if options.quick else 1.0)
    names = options.only or list(SCENES)[:: 3 if options.quick else 1]
    table = Table(
        scene="<26",
        lit="<4",
        degrees="6.1f",
        shade=".2f",
        before=".2f",
        IoU=".2f",
        known=".2f",
        dB_before=".1f",
        dB=".1f",
        s=".1f",
        note="<",
    )
    rows, pictures = [], []
    for name in names:
        row, picture = row_of(name, list(SCENES).index(name), options)
        rows.append(row)
        pictures.append(picture)
        table.row(
            *(name, "yes" if row["is_lit"] else "no", row.get("degrees"), row.get("shade"), row.get("iou_before")),
            *(row.get("iou"), row.get("iou_known_light"), row["psnr_before"], row["psnr"], row["seconds"], row["note"]),
        )
    lit = [row for row in rows if row["is_lit"]]
    before, after, known = (
        np.mean([row[key] for row in lit if key in row]) for key in ("iou_before", "iou", "iou_known_light")
    )
    print(f"shadow_overlap {after:.3f}; straight below {before:.3f}; with the known light {known:.3f}")
    before, after = (np.mean([row[key] for row in lit]) for key in ("psnr_before", "psnr"))
    print(f"relit_psnr {after:.2f} dB; without relighting {before:.2f} dB")
    report(options, rows, aims=aims_of(rows), picture=np.concatenate(pictures))


if __name__ == "__main__":
    main()
