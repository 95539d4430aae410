"""Popping caused by splits, measured by the motion-compensated difference between successive frames of a bend and
twist.

For every frame, the optical flow to the next frame is also rendered. The next frame is warped back by this flow and
compared with the frame. The difference varies smoothly over time unless something pops. Three clouds are compared:
unsplit; split once for the whole motion, as the engine does; and, as a control whose pops must be detected, split in
every fourth frame by that frame's bend.

A frame pops if its difference exceeds 1.3 times the median difference of the frames around it. Aims: ``no_popping`` (no
frame of the cloud that was split for the motion pops), ``control_pops`` (the measure detects the control).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from scipy import ndimage

import mesh_scenes as scenes
from egs_warp.deformation.deformer import Deformer
from egs_warp.deformation.embedding import CageLocator, embed_gaussians
from egs_warp.deformation.splitting import split_bent, split_for_motion
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.io.capture import read_capture
from egs_warp.render import render_gaussians
from harness import Row, Table, data_folder, flags, report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POP = 1.3


def projected(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Return the projections (P, 2), in pixels, of ``points`` (P, 3)."""
    local = points @ camera.rotation.T + camera.translation
    return local[:, :2] / local[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def flow_to(camera: Camera, now: GaussianCloud, after: GaussianCloud) -> np.ndarray:
    """Return the optical flow (H, W, 2), in pixels, from ``now`` to ``after``, blended like colour."""
    moved = projected(camera, after.means.numpy()) - projected(camera, now.means.numpy())
    reach = max(float(np.abs(moved).max()), 1e-6)
    colour = np.zeros((now.count, 1, 3))
    # Colours lie between 0 and 1, so 0.5 encodes zero flow.
    colour[:, 0, :2] = moved / (2.0 * reach) / SH_BAND_0
    image = render_gaussians(
        replace(now, sh=wp.array(colour, dtype=wp.vec3, device=now.device)), camera, background=(0.0, 0.0, 0.0)
    )
    alpha = np.maximum(image.alpha.numpy(), 1e-3)[..., None]
    return np.where(alpha > 0.05, 2.0 * reach * (image.colour.numpy()[..., :2] / alpha - 0.5), 0.0)


def differences(camera: Camera, clouds: list[GaussianCloud], flows: list[np.ndarray]) -> np.ndarray:
    """Return the root mean square differences (F - 1,) between each frame and the next frame, warped back by
    ``flows``."""
    pictures = [render_gaussians(cloud, camera).colour.numpy() for cloud in clouds]
    rows, columns = np.mgrid[: camera.height, : camera.width].astype(float)
    result = []
    for picture, following, flow in zip(pictures[:-1], pictures[1:], flows, strict=True):
        back = [rows + flow[..., 1], columns + flow[..., 0]]
        compensated = np.stack(
            [ndimage.map_coordinates(following[..., c], back, order=3, mode="nearest") for c in range(3)], axis=-1
        )
        result.append(float(np.sqrt(np.mean((compensated - picture) ** 2))))
    return np.array(result)


def pops(values: np.ndarray) -> np.ndarray:
    """Return each value divided by the median of the six values around it."""
    around = np.stack([np.roll(values, shift) for shift in (-3, -2, -1, 1, 2, 3)])[:, 3:-3]
    return values[3:-3] / np.median(around, axis=0)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = flags(__doc__, quick="200 pixels and 40 frames", seed="not used: nothing here is random")
    parser.add_argument("--capture", type=Path, default=data_folder() / "objects" / "plush_dog.ply")
    options = parser.parse_args(arguments)
    size, count = (200, 40) if options.quick else (400, 90)
    cloud = read_capture(options.capture, device=options.device).cloud
    means = cloud.means.numpy().astype(float)
    lower, upper = np.percentile(means, [0.5, 99.5], axis=0)
    middle, extent = 0.5 * (lower + upper), float((upper - lower).max())
    cage = scenes.box_cage(np.array([lower - 0.1 * extent, upper + 0.1 * extent]), 8)
    locator = CageLocator(cage, device=options.device)
    embedding = embed_gaussians(cloud, locator)

    def frame(time: float) -> np.ndarray:
        """Return the nodes at ``time`` (0 to 1): bent forward and twisted about y by angles that rise from 0 to 60
        degrees and fall back to 0."""
        amount = np.radians(60.0) * np.sin(np.pi * time) ** 2
        local = cage.nodes - middle
        height = local[:, 1] / extent
        c, s = np.cos(amount * height), np.sin(amount * height)
        x, y, z = local.T
        x, z = c * x - s * z, s * x + c * z
        y, z = c * y - s * z, s * y + c * z
        return middle + np.stack([x, y, z], axis=1)

    frames = [frame(t) for t in np.linspace(0.0, 1.0, count)]
    camera = Camera.look_at(
        middle + 1.8 * extent * np.array([0.6, -0.2, 0.8]), middle, np.array([0.0, -1.0, 0.0]), width=size, height=size
    )
    unsplit = [Deformer(cloud, embedding).deform(nodes).cloud for nodes in frames]
    flows = [flow_to(camera, a, b) for a, b in zip(unsplit, unsplit[1:], strict=False)]
    split = split_for_motion(cloud, embedding, frames[:: max(1, count // 12)])
    split_ahead = [Deformer(split.cloud, split.embedding).deform(nodes).cloud for nodes in frames]
    each = []
    state = None
    for nodes in frames:
        # The control is split in every fourth frame.
        if len(each) % 4 == 0:
            measured, where = (cloud, embedding) if state is None else (state.cloud, state.embedding)
            state = split_bent(
                measured,
                where,
                Deformer(measured, where).measure_bend([nodes]),
                parents=None if state is None else state.parents,
                depths=None if state is None else state.depths,
            )
        assert state is not None
        each.append(Deformer(state.cloud, state.embedding).deform(nodes).cloud)
    rows: list[Row] = []
    table = Table(cloud="<21", Gaussians="7d", at_the_end="7d", difference=".3e", worst_frame=".2f", that_pop="d")
    for name, clouds in (("unsplit", unsplit), ("split for the motion", split_ahead), ("split in each frame", each)):
        values = differences(camera, clouds, flows)
        ratios = pops(values)
        rows.append(
            {
                "cloud": name,
                "gaussians": [c.count for c in clouds],
                "difference": values.tolist(),
                "worst_ratio": float(ratios.max()),
                "frames_that_pop": int((ratios > POP).sum()),
            }
        )
        table.row(
            name,
            clouds[0].count,
            clouds[-1].count,
            np.median(values),
            rows[-1]["worst_ratio"],
            rows[-1]["frames_that_pop"],
        )

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for row in rows:
            axes.plot(row["difference"], label=row["cloud"])
        axes.set(xlabel="frame", ylabel="difference after motion compensation", yscale="log")
        axes.legend()

    report(
        options,
        rows,
        aims={"no_popping": rows[1]["frames_that_pop"] == 0, "control_pops": rows[2]["frames_that_pop"] > 0},
        draw=draw,
        size=(7.0, 3.0),
    )


if __name__ == "__main__":
    main()
