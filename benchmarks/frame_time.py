"""Cost of a film's frame by stage: deforming the Gaussians, floor shadow, rendering, and download for the video.

python benchmarks/frame_time.py [--quick] [--device cuda:0] [--seed 0] [--json PATH] [--plot PATH]

The pawn, in a cage of about 1,000 nodes, bends back and forth. Each stage is timed separately; the whole frame is timed
without synchronisation between the stages. Aim: ``picture_60hz`` (1,000,000 Gaussians at 1920 x 1080 within 16.7 ms;
null on a CPU). Encoding and the solver's step are not included.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from egs_warp.assets import pawn
from egs_warp.deformation.deformer import Deformer
from egs_warp.deformation.embedding import embed_gaussians
from egs_warp.geometry.body_frame import GROUND
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.pipelines.creature import Creature, CreatureOptions, make_creature
from egs_warp.render.backdrop import studio_floor
from egs_warp.render.compositing import PendingImage
from egs_warp.render.rasteriser import enqueue_image, render_gaussians
from egs_warp.render.shadow import ContactShadow, shadow_blur_radius
from harness import Row, Table, flags, median_ms, report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NODES = 800
"""Value of ``--nodes`` that gives the pawn a cage of about 1,000 nodes."""
SIZES = ((512, 512), (1920, 1080))
FRAME = 1e3 / 60.0


class Studio:
    """Renderer of a creature from one viewpoint, over a floor with its shadow."""

    def __init__(self, creature: Creature, size: tuple[int, int]) -> None:
        height = creature.body.height
        self._deformer = Deformer(creature.cloud, embed_gaussians(creature.cloud, creature.cage.mesh))
        eye, middle = height * np.array([1.6, -2.4, 1.1]), height * np.array([0.0, 0.0, 0.45])
        self.camera = Camera.look_at(eye, middle, np.eye(3)[2], width=size[0], height=size[1])
        where = {"centre": np.zeros(3), "reach": 3.5 * height, "device": creature.cloud.device}
        ground = ContactShadow(
            self.camera, GROUND, blur_radius=shadow_blur_radius(creature.cloud), height=height, **where
        )
        self.behind = studio_floor(ground, cell=0.25 * height)

    def deform(self, nodes: np.ndarray) -> GaussianCloud:
        """Return the Gaussians, deformed by the cage with nodes at ``nodes`` (N, 3)."""
        return self._deformer.deform(nodes).cloud

    def enqueue(self, cloud: GaussianCloud) -> PendingImage:
        """Queue the rendering of ``cloud`` and return at once."""
        behind = self.behind
        return enqueue_image(cloud, self.camera, background=behind.background(cloud), max_depth=behind.floor_depth)


def measure(creature: Creature, size: tuple[int, int], *, repeats: int) -> Row:
    """Return one row for images of ``size`` (width, height)."""
    nodes, height = creature.cage.mesh.nodes, creature.body.height
    studio, device, turn = Studio(creature, size), creature.cloud.device, iter(range(1_000_000))

    def bent() -> np.ndarray:
        lean = 0.2 * np.sin(0.3 * next(turn)) * (nodes[:, 2] / height) ** 2
        return nodes + np.outer(height * lean, [1.0, 0.0, 0.0])

    cloud = studio.deform(bent())
    floor, image = studio.behind.background(cloud), studio.enqueue(cloud).result().image
    stages = {
        "carry": lambda: studio.deform(bent()),
        "shadow": lambda: studio.behind.background(cloud),
        "draw": lambda: render_gaussians(cloud, studio.camera, background=floor),
        "bytes": image.colour_srgb8,
        "whole": lambda: studio.enqueue(studio.deform(bent())).result().image.colour_srgb8(),
    }
    times = median_ms(stages, repeats=repeats, synchronise=lambda: wp.synchronize_device(device))
    return {"gaussians": cloud.count, "width": size[0], "height": size[1], **times}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    options = flags(__doc__, quick="22,000 Gaussians", seed="seed of the Gaussians").parse_args(arguments)
    counts = (22_000,) if options.quick else (22_000, 180_000, 1_000_000)
    table = Table(
        **{"Gaussians": "9d", "width": "5d", "height": "6d"},
        **dict.fromkeys(("carry", "shadow", "draw", "bytes", "whole"), "8.2f"),
    )
    rows: list[Row] = []
    for count in counts:
        scene = pawn(gaussian_count=count, seed=options.seed, device=options.device)
        creature = make_creature(scene.cloud, plane=scene.plane, options=CreatureOptions(nodes=NODES))
        for size in SIZES:
            rows.append(measure(creature, size, repeats=5 if options.quick else 15))
            table.row(*rows[-1].values())
    largest = rows[-1]["whole"] if rows[-1]["gaussians"] > 500_000 else None
    on_gpu = wp.get_device(options.device).is_cuda and largest is not None

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        left = np.zeros(len(rows))
        for stage in ("carry", "shadow", "draw", "bytes"):
            durations = np.array([row[stage] for row in rows])
            axes.barh([f"{row['gaussians']}, {row['width']} x {row['height']}" for row in rows], durations, left=left)
            left += durations
        axes.axvline(FRAME, color="0.5")
        axes.set_xlabel("milliseconds per image: carry, shadow, draw, bytes")

    report(
        options,
        rows,
        aims={"picture_60hz": largest <= FRAME if on_gpu and largest is not None else None},
        why_null={} if on_gpu else {"picture_60hz": "only measured on a GPU with 1,000,000 Gaussians"},
        draw=draw,
    )


if __name__ == "__main__":
    main()
