"""Preparation of a scene: from a capture to an object, its ground plane, and a background without the object."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from egs_warp.checked_calls import checked_constructor, checked_method
from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.frames import Direction, direction_of
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.main_light import MainLight
from egs_warp.geometry.plane import Plane
from egs_warp.inpainting.holes import Hole, hole_under
from egs_warp.inpainting.inpaint import InpaintOptions, InpaintResult, inpaint
from egs_warp.inpainting.inpainters import Inpainter
from egs_warp.inpainting.underside import with_underside
from egs_warp.io.planes import PlaneRecord, write_planes
from egs_warp.io.ply import write_ply
from egs_warp.io.run_folder import RunFolder
from egs_warp.lighting.estimate import estimate_light
from egs_warp.notes import Detail, Problem
from egs_warp.pipelines.ground_coverage import ground_edge_note
from egs_warp.pipelines.locate_plane import LocatedPlane, locate_plane, with_measured_ground
from egs_warp.pipelines.scene_costs import scene_costs
from egs_warp.segmentation.clearance import StraddlingOptions, StraddlingPolicy, clear_plane, plane_extents
from egs_warp.segmentation.object_spec import ObjectSpec
from egs_warp.short_repr import short_repr
from egs_warp.training import has_torch

if TYPE_CHECKING:
    from egs_warp.training.training_view import TrainingView

_CLEARED = {
    StraddlingPolicy.NONE: "left as they are",
    StraddlingPolicy.REMOVE: "left out",
    StraddlingPolicy.FINETUNE: "fine-tuned clear of it",
    StraddlingPolicy.SPLIT: "split at it",
}


_SOLID = 0.1
"""Minimum opacity of Gaussians that define the lowest part of an object."""
_TRAINED = 0.6
"""Finished fraction of the stage "segment" when the training at the plane has ended and the estimate of the light
begins."""
_HOVER_FRACTION = 0.03
"""Distance from the plane above which an object hovers, as a fraction of the object's size."""


@checked_constructor
@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """Options of ``prepare_scene``."""

    clearing: StraddlingPolicy | None = None
    """Treatment of Gaussians that straddle the plane; None fine-tunes them if PyTorch is installed, and otherwise
    splits them."""
    flat: bool = False
    """True to use the plane as ground, without measuring the ground."""
    inpaint: bool = True
    """True to fill the hole under the object in the background."""
    inpainter: Inpainter | None = None
    """Method that fills the hole; None uses patch synthesis."""
    clearing_options: StraddlingOptions = field(default_factory=StraddlingOptions)
    """Options of ``clearing``."""

    @property
    def method(self) -> StraddlingPolicy:
        """Treatment of Gaussians that straddle the plane, with None replaced by the default."""
        return self.clearing or (StraddlingPolicy.FINETUNE if has_torch() else StraddlingPolicy.SPLIT)

    @property
    def inpainting_steps(self) -> int | None:
        """Number of training steps of the inpainting; None if the hole is not filled."""
        if not self.inpaint:
            return None
        return InpaintOptions().steps if has_torch() else 0

    def costs(
        self, gaussian_count: int, *, object_count: int | None = None, hole: Hole | None = None
    ) -> dict[str, float]:
        """Return the expected processor time of each stage of ``prepare_scene``, s, in the order of the stages
        (``scene_costs``)."""
        return scene_costs(
            gaussian_count,
            has_ground=not self.flat,
            clearing_steps=self.clearing_options.iterations if self.method is StraddlingPolicy.FINETUNE else 0,
            inpainting_steps=self.inpainting_steps,
            object_count=object_count,
            hole=hole,
        )


@dataclass(frozen=True)
class PreparedScene:
    """A capture that is separated into object and background, in scene units."""

    __repr__ = short_repr

    object: GaussianCloud
    """Gaussians of the object, cleared of the plane."""
    background: GaussianCloud
    """Gaussians of the capture without the object, inpainted if requested."""
    background_with_hole: GaussianCloud = field(repr=False)
    """The background before inpainting."""
    plane: Plane
    """Ground plane under the object."""
    hole: Hole | None
    """Hole in the floor under the object; None if the object hovers above the floor."""
    located: LocatedPlane = field(repr=False)
    """Details of the plane and of the segmentation."""
    notes: tuple[str, ...] = field(repr=False)
    """Notes on the stages, for the user."""
    filled: InpaintResult | None = field(default=None, repr=False)
    """Result of the inpainting; None if there was none."""
    light: MainLight | None = None
    """Main light of the capture; None if its estimate is uncertain."""

    @property
    def ground(self) -> HeightField | None:
        """Ground under the object if it is not flat, otherwise None."""
        return self.located.ground

    @checked_method
    def write(self, out: Path | RunFolder, known: Sequence[PlaneRecord] = (), *, has_background: bool = True) -> None:
        """Write ``object.ply``, ``background.ply`` and ``plane.json``.

        Args:
            out: A folder, or the folder of a run.
            known: Records of the file from which the plane was read; values that have not been measured again are
                copied from them.
            has_background: True to write ``background.ply``.
        """
        file_path = out.file if isinstance(out, RunFolder) else out.joinpath
        write_ply(file_path("object.ply"), self.object)
        if has_background:
            write_ply(file_path("background.ply"), self.background)
        first = replace(self.located.known(), hole=self.hole.outline() if self.hole else None, light=self.light)
        write_planes(file_path("plane.json"), [first.merged_with(known[0]) if known else first, *known[1:]])


def prepare_scene(
    cloud: GaussianCloud,
    spec: ObjectSpec,
    *,
    cameras: Sequence[Camera] = (),
    photographs: Sequence[TrainingView] | None = None,
    up: Direction | None = None,
    plane: Plane | None = None,
    options: SceneOptions | None = None,
    progress: Callable[[str, float], None] = lambda stage, done: None,
    expect_costs: Callable[[Mapping[str, float]], None] = lambda costs: None,
) -> PreparedScene:
    """Separate a capture into object and background: plane, segmentation, clearing of the plane, inpainting.

    Args:
        cloud: The capture.
        spec: Specification of the object.
        cameras: Cameras of the capture, if known.
        photographs: Photos of the whole scene for the fine-tuning at the plane; None uses renders of the capture.
        up: (3,) Approximate up direction, or an axis such as ``"-y"``; None uses the one in the file, or else an
            estimate.
        plane: The ground plane; None finds it.
        options: Options; None uses the default.
        progress: Called with the name of a stage and its finished fraction.
        expect_costs: Called with the expected processor times of all stages (``SceneOptions.costs``) as soon as the
            sizes of the object and of the hole are known.

    Raises:
        UserError: A stage failed.
    """
    options = options or SceneOptions()
    up = None if up is None else direction_of(up, "up")
    progress("plane", 0.0)
    located = locate_plane(cloud, spec, cameras=cameras, up=up, plane=plane)
    if not options.flat:
        progress("ground", 0.0)
        located = with_measured_ground(cloud, located, spec, cameras)
    hole = hole_under(cloud, located.plane, located.segmentation)
    expected = replace(options, inpaint=options.inpaint and hole is not None and located.in_sight)
    object_count = int(located.segmentation.object_mask.sum())
    expect_costs(expected.costs(cloud.count, object_count=object_count, hole=hole))
    progress("segment", 0.0)
    object_cloud, background_with_hole, notes = segment_scene(
        cloud, located, options, photographs, progress=lambda done: progress("segment", _TRAINED * done)
    )
    object_cloud, snap_notes = snap_to_plane(object_cloud, located)
    notes = (*notes, *snap_notes)
    # Estimate the light before the hole is filled, because filling replaces a part of the shadow.
    lighting = estimate_light(object_cloud, background_with_hole, located.ground or located.plane)
    if located.in_sight:
        means = object_cloud.means.numpy().astype(np.float64)
        notes = (*notes, *ground_edge_note(means, background_with_hole, located.plane, located.ground))
    notes = (*notes, lighting.note)
    filled = None
    if options.inpaint and hole is None:
        hangs = "" if snap_notes else "the object hangs above the ground, and "
        notes = (*notes, f"{hangs}the ground under the object is complete")
    elif options.inpaint and not located.in_sight:
        notes = (*notes, "what is under the object was not filled, because no view shows where the ground is")
    elif options.inpaint and hole is not None:
        progress("inpaint", 0.0)
        assert options.inpainting_steps is not None
        chosen = InpaintOptions(steps=options.inpainting_steps)
        show_inpainting = lambda done: progress("inpaint", done)  # noqa: E731
        try:
            filled = inpaint(
                background_with_hole, hole, inpainter=options.inpainter, options=chosen, progress=show_inpainting
            )
            notes = (*notes, *map(Detail, filled.notes))
        except UserError as error:
            # A floor with a hole is acceptable, so a failure to fill it must not prevent the animation.
            notes = (*notes, Problem(f"the floor under the object was not filled ({error})"))
    background = background_with_hole if filled is None else filled.cloud
    return PreparedScene(
        *(object_cloud, background, background_with_hole, located.plane, hole, located, (*located.notes, *notes)),
        filled=filled,
        light=lighting.light,
    )


def segment_scene(
    cloud: GaussianCloud,
    located: LocatedPlane,
    options: SceneOptions,
    photographs: Sequence[TrainingView] | None = None,
    *,
    progress: Callable[[float], None] = lambda done: None,
) -> tuple[GaussianCloud, GaussianCloud, tuple[str, ...]]:
    """Separate the object from the capture, and clear it of the plane.

    Args:
        cloud: The capture.
        located: Plane and segmentation.
        options: Options of the scene.
        photographs: Photos of the whole scene for the fine-tuning; None uses renders.
        progress: Called with the finished fraction of the fine-tuning.

    Returns:
        The object, the background with a hole, and notes for the user.
    """
    segmentation, method = located.segmentation, options.method
    straddling_cloud, ground = cloud.subset(segmentation.object_mask), located.ground
    if ground is not None:
        # Flatten the ground to the plane, because ``clear_plane`` can clear the object only of a plane.
        straddling_cloud, photographs = _moved(straddling_cloud, ground.flatten), None
    heights, reach = plane_extents(straddling_cloud, located.plane, options.clearing_options.reach)
    if not segmentation.background_mask.any():
        raise UserError("object: it is the whole capture, so there is no background; animate the capture itself")
    object_cloud = clear_plane(
        straddling_cloud,
        located.plane,
        method,
        views=photographs or None,
        surroundings=cloud.subset(~segmentation.object_mask) if photographs else None,
        options=options.clearing_options,
        progress=lambda step, _: progress((step + 1) / options.clearing_options.iterations),
    )
    underside_notes = ()
    if ground is not None:
        object_cloud, count = with_underside(_moved(object_cloud, ground.unflatten), ground, segmentation.size)
        underside_notes = (f"its underside, which no view shows, was closed by {count} Gaussians",) if count else ()
    notes = (
        f"the object has {straddling_cloud.count} of {cloud.count} Gaussians;"
        f" {int(segmentation.buried_mask.sum())} under it and"
        f" {int(segmentation.floater_mask.sum())} floaters beside it were dropped",
        f"{int((np.abs(heights) < reach).sum())} of the object's Gaussians straddled the plane: {_CLEARED[method]}"
        + (f" against {len(photographs)} photographs" if photographs and method is StraddlingPolicy.FINETUNE else ""),
        *underside_notes,
    )
    return object_cloud, cloud.subset(segmentation.background_mask), tuple(map(Detail, notes))


def snap_to_plane(object_cloud: GaussianCloud, located: LocatedPlane) -> tuple[GaussianCloud, tuple[str, ...]]:
    """Move the object down onto its plane if it hovers above the plane, as happens in some captures of robots.

    Returns:
        The object, and a note if it was moved.
    """
    plane, size = located.plane, located.segmentation.size
    lowest = float(np.quantile(plane.heights(object_cloud.means.numpy()[object_cloud.visible(_SOLID)]), 0.002))
    if located.ground is not None or lowest <= _HOVER_FRACTION * size:
        return object_cloud, ()
    note = f"the object was {lowest / size:.2f} of its size above the ground, and was lowered onto it"
    return _moved(object_cloud, lambda means: means - lowest * plane.normal), (note,)


def _moved(cloud: GaussianCloud, to: Callable[[np.ndarray], np.ndarray]) -> GaussianCloud:
    """Return ``cloud`` with its means replaced by ``to(means)``."""
    means = to(cloud.means.numpy().astype(np.float64)).astype(np.float32)
    return replace(cloud, means=wp.array(means, dtype=wp.vec3, device=cloud.device))


def viewing_directions(scene: PreparedScene, cameras: Sequence[Camera]) -> np.ndarray | None:
    """Return viewing directions (n, 3) from the object to cameras of the capture; None without cameras above the plane.

    A capture has the best quality as seen from its own cameras. The half of the cameras with medium elevation is used.
    """
    normal, centre = scene.plane.normal, scene.located.centre
    arms = np.array([one.centre - centre for one in cameras if scene.plane.heights(one.centre) > 0.0]).reshape(-1, 3)
    if len(arms) == 0:
        return None
    by_height = np.argsort(arms @ normal / np.linalg.norm(arms, axis=1), kind="stable")
    quarter = len(arms) // 4
    return arms[np.sort(by_height[quarter : len(arms) - quarter])]
