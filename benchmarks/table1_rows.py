"""One object of Table 1: its captures, its motions, and the scores of every deformation method."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
import warp as wp

import mesh_scenes as scenes
from capture_surface import capture_surface
from drop import Drop, simulated_drop
from egs_warp.deformation.baselines import DeformationMethod, deform_with_method
from egs_warp.deformation.embedding import CageLocator, embed_gaussians, embed_points
from egs_warp.deformation.splitting import SplitRule, split_for_motion
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.meshing.cage import build_cage
from egs_warp.render import render_gaussians
from egs_warp.training.metrics import psnr, ssim
from egs_warp.training.training_view import TrainingView
from harness import Row, Table, timed
from painted_meshes import PaintedMesh
from perceptual import flip_error, lpips_distance

MOTIONS = ("bend", "twist", "fall")
CAGE_NODES = {"plant": 2000, "microphone": 500}
"""Number of cage nodes by object, otherwise 1000. The cage must contain the whole mesh, including thin leaves, because
the deformation is not defined outside the cage."""
ON_LEGS, ON_LEAVES = (0.15, 0.6, 20.0), (0.3, 0.8, 150.0)
"""Sag, height (m) and tilt (degrees) of a fall onto the legs and of a fall onto the leaves; only the plant falls onto
its leaves."""
FLOOR = Plane.from_coefficients(0.0, 0.0, 1.0, 0.0)
AS_TRAINED, SPLIT, PAPER_SPLIT, AS_MANY = "as trained", "our split", "the paper's split", "trained with as many"
"""Captures: as trained; two splits of the trained capture for the motion; and a capture trained with the mean number of
Gaussians that our split has over the motions."""
PAPER_DEGREES = 9.0
"""Maximum bend of the paper, degrees: 15 degrees between arms of 3 standard deviations, converted to arms of sqrt(3)
standard deviations."""


@dataclass(frozen=True)
class TableRow:
    """One row of the table."""

    capture: str
    method: DeformationMethod
    on_cage: bool = False
    """True if ``SURFACE`` binds to the cage's own faces instead of a surface of the capture."""
    rotates_colour: bool = True


WHOLE = DeformationMethod.BIDIRECTIONAL_NO_SPLIT
BASELINES = {
    "SuGaR": DeformationMethod.SURFACE,
    "PhysGaussian": DeformationMethod.MEAN_GRADIENT,
    "VR-GS": DeformationMethod.LOCAL_TETRAHEDRON,
}
MAIN = {
    **{name: TableRow(AS_TRAINED, method) for name, method in BASELINES.items()},
    "ours, no split": TableRow(AS_TRAINED, WHOLE),
    "ours, paper's split": TableRow(PAPER_SPLIT, WHOLE),
    "ours": TableRow(SPLIT, WHOLE),
}
SAME_SPLIT = {f"{name}, our split": TableRow(SPLIT, method) for name, method in BASELINES.items()}
"""Rows that deform the same Gaussians as the row "ours", so that the number of Gaussians and the image at rest are
equal."""
SAME_TRAINING = {
    **{f"{name}, as many": TableRow(AS_MANY, method) for name, method in BASELINES.items()},
    "ours, no split, as many": TableRow(AS_MANY, WHOLE),
}
ROWS = {
    **MAIN,
    "ours, colours not rotated": TableRow(SPLIT, WHOLE, rotates_colour=False),
    "SuGaR, on the cage's faces": TableRow(AS_TRAINED, DeformationMethod.SURFACE, on_cage=True),
    **SAME_SPLIT,
    **SAME_TRAINING,
}


@dataclass(frozen=True)
class Splitting:
    """Settings of splitting, which are arguments of ``split_for_motion``."""

    degrees: float
    min_error: float
    """Minimum fit error, as a fraction of the cage's diagonal."""
    depth: int
    growth: float

    def apply(
        self, cloud: GaussianCloud, cage: TetMesh, nodes: np.ndarray, rule: SplitRule = SplitRule.MEASURED
    ) -> GaussianCloud:
        """Return ``cloud`` at rest, split for ``nodes`` (N, 3)."""
        locator = CageLocator(cage, device=cloud.device)
        return split_for_motion(
            cloud,
            embed_gaussians(cloud, locator),
            [nodes],
            threshold_degrees=self.degrees,
            min_error=self.min_error * locator.extent,
            rule=rule,
            max_depth=self.depth,
            max_growth=self.growth,
        ).cloud


class Subject:
    """An object with its cage, its motions and its captures."""

    def __init__(self, mesh: PaintedMesh, options: argparse.Namespace) -> None:
        self.mesh, self.options = replace(mesh, glossy=not options.matt), options
        # The cage is built from the surface instead of a trained cloud, so that the cage and the fall are the same for
        # every training.
        self._surface = scenes.surface_cloud(mesh, 40_000, device="cpu")
        self.cage = build_cage(self._surface, FLOOR, target_nodes=options.nodes or CAGE_NODES.get(mesh.name, 1000)).mesh

    @cached_property
    def photos(self) -> list[TrainingView]:
        """Photographs of the mesh at rest, for training."""
        return scenes.photographs(self.mesh, self.options.size, self.options.views, self.options.device)

    def moved_nodes(self) -> dict[str, np.ndarray]:
        """Return the positions (N, 3) of the cage's nodes in each motion; the drop is simulated with a coarse cage."""
        cached = self.options.clouds / f"{self.mesh.name}_drop.npz" if self.options.clouds else None
        if cached is not None and cached.exists():
            with np.load(cached) as arrays:
                dropped = Drop(**arrays)
        else:
            coarse = build_cage(self._surface, FLOOR, target_nodes=250).mesh
            sag, height, tilt = ON_LEAVES if self.mesh.name == "plant" else ON_LEGS
            dropped, milliseconds = timed(
                simulated_drop, coarse, self._surface, sag=sag, height=height, tilt_degrees=tilt, seconds=0.3
            )
            print(f"  drop: {len(coarse.nodes)} nodes, simulated in {1e-3 * milliseconds:.0f} s", flush=True)
            if cached is not None:
                np.savez_compressed(cached, frames=dropped.frames, energies=dropped.energies, rest=dropped.rest)
        motions = {"bend": scenes.bend, "twist": scenes.twist_by(150.0), "fall": dropped.at_impact}
        return {name: motions[name](self.cage.nodes) for name in MOTIONS}

    def trained(self, gaussians: int) -> GaussianCloud:
        """Train the object at rest, or read the cloud from the cache ``--clouds``."""
        options = self.options
        look = "matt" if options.matt else "glossy"
        cached = options.clouds / f"{self.mesh.name}_{look}_{options.size}_{gaussians}.npz" if options.clouds else None
        if cached is not None and cached.exists():
            with np.load(cached) as arrays:
                return GaussianCloud.from_numpy(**arrays, device=options.device)
        cloud, milliseconds = timed(
            scenes.trained_on,
            self.mesh,
            self.photos,
            gaussians,
            options.iterations,
            seed=options.seed,
            degree=0 if options.matt else 3,
            device=options.device,
        )
        print(f"{self.mesh.name}: {cloud.count} Gaussians trained in {1e-3 * milliseconds:.0f} s", flush=True)
        if cached is not None:
            arrays = {field: getattr(cloud, field).numpy() for field in cloud.__dataclass_fields__}
            np.savez_compressed(cached, **arrays)
        return cloud

    def views(self, vertices: np.ndarray) -> list[View]:
        """Render held-out images of the mesh with its vertices at ``vertices`` (V, 3), the ground truth."""
        options = self.options
        cameras = scenes.ring(vertices, options.judges, options.size, elevations=(10.0, 40.0), phase=0.37)
        photos = scenes.photograph(self.mesh, vertices, cameras, options.device)
        return [View(camera, *photo) for camera, photo in zip(cameras, photos, strict=True)]

    def inside_share(self) -> float:
        """Return the fraction of the mesh's vertices inside the cage."""
        return float(embed_points(self.cage, self.mesh.vertices, device=self.options.device).inside.numpy().mean())


@dataclass(frozen=True)
class View:
    """A held-out image."""

    camera: Camera
    picture: np.ndarray
    """(H, W, 3) colour of the image."""
    coverage: np.ndarray
    """(H, W) fraction of each pixel that the mesh covers."""

    def judge(self, cloud: GaussianCloud) -> tuple[dict[str, float], np.ndarray]:
        """Return the scores of the rendered image of ``cloud``, and the image."""
        image = render_gaussians(cloud, self.camera)
        picture = np.clip(image.colour.numpy(), 0.0, 1.0)
        pair = [torch.as_tensor(one, dtype=torch.float32) for one in (picture, self.picture)]
        if str(cloud.device) != "cpu":
            pair = [one.to(wp.device_to_torch(cloud.device)) for one in pair]
        distance, _ = lpips_distance()
        return {
            "psnr": psnr(picture, self.picture),
            "ssim": float(ssim(*pair)),
            "flip": flip_error(*pair),
            "lpips": distance(picture, self.picture) if distance else np.nan,
            "outside_silhouette": scenes.outside(image.alpha.numpy(), self.coverage),
        }, picture


def _without_nan(scores: Mapping[str, float]) -> dict[str, float | None]:
    """Replace NaN by None, because JSON has no NaN."""
    return {key: None if np.isnan(value) else value for key, value in scores.items()}


def judged(cloud: GaussianCloud, views: list[View]) -> tuple[dict[str, float], np.ndarray]:
    """Return the mean scores over the views, and the image of the first view."""
    results = [view.judge(cloud) for view in views]
    return {key: float(np.mean([one[key] for one, _ in results])) for key in results[0][0]}, results[0][1]


def object_rows(
    mesh: PaintedMesh, options: argparse.Namespace, splitting: Splitting
) -> tuple[list[Row], list[np.ndarray]]:
    """Return scores of every row and motion for one object, and a strip of images for each motion."""
    subject = Subject(mesh, options)
    moved = subject.moved_nodes()
    cloud = subject.trained(options.gaussians)
    split = {motion: splitting.apply(cloud, subject.cage, nodes) for motion, nodes in moved.items()}
    many = subject.trained(round(np.mean([one.count for one in split.values()])))
    surfaces = {AS_TRAINED: capture_surface(cloud), AS_MANY: capture_surface(many)}
    surfaces[SPLIT] = surfaces[AS_TRAINED]
    at_rest = {
        name: judged(one, subject.views(mesh.vertices))[0]["psnr"]
        for name, one in ((AS_TRAINED, cloud), (AS_MANY, many))
    }
    print(
        f"  cage {len(subject.cage.nodes)} nodes, {100 * subject.inside_share():.2f} % of the vertices inside;"
        f" held-out views at rest {at_rest[AS_TRAINED]:.2f} dB, {at_rest[AS_MANY]:.2f} dB with {many.count} Gaussians",
        flush=True,
    )
    rows: list[Row] = []
    strips = []
    table = Table(motion="<6", row="<26", dB=".2f", SSIM=".4f", FLIP=".4f", Gaussians="7d")
    for motion, nodes in moved.items():
        vertices = scenes.carried_vertices(subject.mesh, subject.cage, nodes, options.device)
        views = subject.views(vertices)
        paper = replace(splitting, degrees=PAPER_DEGREES).apply(cloud, subject.cage, nodes, SplitRule.PAPER)
        captures = {AS_TRAINED: cloud, SPLIT: split[motion], PAPER_SPLIT: paper, AS_MANY: many}
        strip = [views[0].picture]
        for name, row in ROWS.items():
            capture = captures[row.capture]
            surface = None if row.on_cage else surfaces.get(row.capture)
            (carried,) = deform_with_method(capture, subject.cage, [nodes], method=row.method, surface=surface)
            if not row.rotates_colour:
                carried = replace(carried, sh=capture.sh)
            scores, picture = judged(carried, views)
            if name in MAIN:
                strip.append(picture)
            rows.append(
                {
                    "object": mesh.name,
                    "motion": motion,
                    "row": name,
                    "method": row.method.value,
                    "capture": row.capture,
                    "gaussians": carried.count,
                    **_without_nan(scores),
                    "psnr_at_rest": at_rest.get(row.capture),
                }
            )
            table.row(motion, name, scores["psnr"], scores["ssim"], scores["flip"], carried.count)
        # Images of 400 pixels are large enough to show the differences.
        coarser = max(1, strip[0].shape[0] // 400)
        strips.append(np.concatenate([p[::coarser, ::coarser] for p in strip], axis=1))
    return rows, strips


def settings_rows(mesh: PaintedMesh, options: argparse.Namespace, settings: Mapping[str, Splitting]) -> list[Row]:
    """Return the rows of our method with each of ``settings``, for one object and every motion."""
    subject = Subject(mesh, options)
    cloud = subject.trained(options.gaussians)
    rows = []
    table = Table(motion="<6", setting="<24", dB=".3f", SSIM=".4f", FLIP=".4f", Gaussians="7d")
    for motion, nodes in subject.moved_nodes().items():
        views = subject.views(scenes.carried_vertices(subject.mesh, subject.cage, nodes, options.device))
        for name, splitting in settings.items():
            (carried,) = deform_with_method(
                splitting.apply(cloud, subject.cage, nodes), subject.cage, [nodes], method=WHOLE
            )
            scores, _ = judged(carried, views)
            rows.append(
                {
                    "object": mesh.name,
                    "motion": motion,
                    "setting": name,
                    "gaussians": carried.count,
                    **_without_nan(scores),
                }
            )
            table.row(motion, name, scores["psnr"], scores["ssim"], scores["flip"], carried.count)
    return rows
