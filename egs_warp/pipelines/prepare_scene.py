"""From a capture of a scene to an object, the plane it stands on, and a background without it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.inpainting.holes import Hole, hole_under
from egs_warp.inpainting.underside import with_underside
from egs_warp.io.planes import PlaneRecord, write_planes
from egs_warp.io.ply import write_ply
from egs_warp.io.run_folder import RunFolder
from egs_warp.pipelines.locate_plane import LocatedPlane, locate_plane, with_measured_ground
from egs_warp.segmentation.clearance import StraddlingOptions, StraddlingPolicy, clear_plane, plane_extents
from egs_warp.segmentation.object_spec import ObjectSpec
from egs_warp.training import has_torch

if TYPE_CHECKING:
    from egs_warp.inpainting.inpaint import InpaintResult
    from egs_warp.inpainting.inpainters import Inpainter
    from egs_warp.training.finetune import TrainingView

_CLEARED = {
    StraddlingPolicy.NONE: "left as they are",
    StraddlingPolicy.REMOVE: "left out",
    StraddlingPolicy.FINETUNE: "fine-tuned clear of it",
    StraddlingPolicy.SPLIT: "split at it",
}


_SOLID = 0.1
_HOVER_FRACTION = 0.03
"""Of the object's size: what hangs higher above its plane does not stand there."""


@dataclass(frozen=True)
class SceneOptions:
    """What may be chosen."""

    clearing: StraddlingPolicy | None = None
    """None: fine-tuning where PyTorch is installed, else the static split."""
    flat: bool = False
    """Stand on the plane, whatever the ground is like."""
    inpaint: bool = True
    inpainter: Inpainter | None = None
    """None: patch synthesis."""
    clearing_options: StraddlingOptions = field(default_factory=StraddlingOptions)

    @property
    def method(self) -> StraddlingPolicy:
        """How the object is cleared of the plane."""
        return self.clearing or (StraddlingPolicy.FINETUNE if has_torch() else StraddlingPolicy.SPLIT)

    @property
    def stages(self) -> dict[str, bool]:
        """Names of what ``prepare_scene`` will do, in its order, and whether all of it, training included."""
        asked = {"plane": True, "ground": not self.flat, "segment": True, "inpaint": self.inpaint}
        whole = {"segment": self.method is StraddlingPolicy.FINETUNE, "inpaint": has_torch()}
        return {name: whole.get(name, True) for name, wanted in asked.items() if wanted}


@dataclass(frozen=True)
class PreparedScene:
    """A capture taken apart; scene units."""

    object: GaussianCloud
    """Clear of the plane."""
    background: GaussianCloud
    """Without the object; with new floor where it stood, if that was asked for."""
    background_with_hole: GaussianCloud
    """The background before inpainting."""
    plane: Plane
    hole: Hole | None
    """In the floor, under the object; None where it hangs above it."""
    located: LocatedPlane
    notes: tuple[str, ...]
    """What was found and done, for the user."""
    filled: InpaintResult | None = None
    """How the background got its new floor; None where it got none."""

    @property
    def ground(self) -> HeightField | None:
        """What the object stands on where that is not flat."""
        return self.located.ground

    def write(self, out: Path | RunFolder, known: Sequence[PlaneRecord] = ()) -> None:
        """``object.ply``, ``background.ply`` and ``plane.json`` into the folder ``out``, or as files of a run.

        ``known`` is what the file that gave the plane held; what is not found anew goes along.
        """
        place = out.file if isinstance(out, RunFolder) else out.joinpath
        write_ply(place("object.ply"), self.object)
        write_ply(place("background.ply"), self.background)
        first = replace(self.located.known(), hole=self.hole.outline() if self.hole else None)
        write_planes(place("plane.json"), [first.merged_with(known[0]) if known else first, *known[1:]])


def prepare_scene(
    cloud: GaussianCloud,
    spec: ObjectSpec,
    *,
    cameras: Sequence[Camera] = (),
    photographs: Sequence[TrainingView] | None = None,
    up: np.ndarray | None = None,
    plane: Plane | None = None,
    options: SceneOptions | None = None,
    progress: Callable[[str, float], None] = lambda stage, done: None,
) -> PreparedScene:
    """Everything between a capture and its animation: plane, segmentation, clearing of the plane, inpainting.

    ``cameras`` are the capture's own, if known; ``photographs`` of the whole scene take the place of renders in the
    fine-tune at the plane; ``up`` (3,) is roughly up, and guessed if not given; ``progress`` is
    told the name of each stage and the share of it that is done. Raises ``UserError`` as the stages do.
    """
    options = options or SceneOptions()
    progress("plane", 0.0)
    located = locate_plane(cloud, spec, cameras=cameras, up=up, plane=plane)
    if not options.flat:
        progress("ground", 0.0)
        located = with_measured_ground(cloud, located, spec, cameras)
    progress("segment", 0.0)
    thing, bare, notes = segment_scene(
        cloud, located, options, photographs, progress=lambda done: progress("segment", done)
    )
    thing, came_down = snap_to_plane(thing, located)
    notes = (*notes, *came_down)
    filled, hole = None, hole_under(cloud, located.plane, located.segmentation)
    if options.inpaint and hole is None:
        notes = (*notes, "the object hangs above the ground, which is whole under it")
    elif options.inpaint and not located.in_sight:
        notes = (*notes, "what is under the object was not filled, as no view tells where the ground is")
    elif options.inpaint and hole is not None:
        progress("inpaint", 0.0)
        # torch may be missing, and with it the training that inpainting ends with.
        from egs_warp.inpainting.inpaint import InpaintOptions, inpaint

        chosen = InpaintOptions() if has_torch() else InpaintOptions(steps=0)
        painted = lambda done: progress("inpaint", done)  # noqa: E731
        try:
            filled = inpaint(bare, hole, inpainter=options.inpainter, options=chosen, progress=painted)
            notes = (*notes, *filled.notes)
        except UserError as error:
            # A floor with a hole is worth more than no animation.
            notes = (*notes, f"the floor under the object was not filled ({error})")
    background = bare if filled is None else filled.cloud
    return PreparedScene(thing, background, bare, located.plane, hole, located, (*located.notes, *notes), filled)


def segment_scene(
    cloud: GaussianCloud,
    located: LocatedPlane,
    options: SceneOptions,
    photographs: Sequence[TrainingView] | None = None,
    *,
    progress: Callable[[float], None] = lambda done: None,
) -> tuple[GaussianCloud, GaussianCloud, tuple[str, ...]]:
    """Object, clear of the plane; background with a hole; and what there is to say. ``progress`` is told the share of
    the fine-tune that is done.
    """
    found, method = located.segmentation, options.method
    untouched, ground = cloud.subset(found.object_mask), located.ground
    if ground is not None:
        # Where the ground is the plane, what stands on it can be cleared of the plane.
        untouched, photographs = _moved(untouched, ground.flatten), None
    heights, reach = plane_extents(untouched, located.plane, options.clearing_options.reach)
    if not found.background_mask.any():
        raise UserError("object: it is the whole capture, so there is no background; animate the capture itself")
    thing = clear_plane(
        untouched,
        located.plane,
        method,
        views=photographs or None,
        surroundings=cloud.subset(~found.object_mask) if photographs else None,
        options=options.clearing_options,
        progress=lambda step, _: progress((step + 1) / options.clearing_options.iterations),
    )
    closed = ()
    if ground is not None:
        thing, count = with_underside(_moved(thing, ground.unflatten), ground, found.size)
        closed = (f"its underside, which no view shows, was closed by {count} Gaussians",) if count else ()
    notes = (
        f"the object has {untouched.count} of {cloud.count} Gaussians; {int(found.buried_mask.sum())} under it and "
        f"{int(found.floater_mask.sum())} floaters beside it were dropped",
        f"{int((np.abs(heights) < reach).sum())} of the object's Gaussians straddled the plane: {_CLEARED[method]}"
        + (f" against {len(photographs)} photographs" if photographs and method is StraddlingPolicy.FINETUNE else ""),
        *closed,
    )
    return thing, cloud.subset(found.background_mask), notes


def snap_to_plane(thing: GaussianCloud, located: LocatedPlane) -> tuple[GaussianCloud, tuple[str, ...]]:
    """``thing``, moved down onto its plane if it hangs above it, as a robot may that was captured afloat; and what to
    say of that.
    """
    plane, size = located.plane, located.segmentation.size
    lowest = float(np.quantile(plane.heights(thing.means.numpy()[thing.opacities() > _SOLID]), 0.002))
    if located.ground is not None or lowest <= _HOVER_FRACTION * size:
        return thing, ()
    note = f"the object hung {lowest / size:.2f} of its size above the ground, and was set down on it"
    return _moved(thing, lambda means: means - lowest * plane.normal), (note,)


def _moved(cloud: GaussianCloud, to: Callable[[np.ndarray], np.ndarray]) -> GaussianCloud:
    """``cloud`` with its means moved."""
    means = to(cloud.means.numpy().astype(np.float64)).astype(np.float32)
    return replace(cloud, means=wp.array(means, dtype=wp.vec3, device=cloud.device))


def viewing_directions(scene: PreparedScene, cameras: Sequence[Camera]) -> np.ndarray | None:
    """(n, 3) from the object to where a picture is best taken: where the capture's own cameras were; None where it has
    none above the plane.

    Captures look best from where they were taken; of those cameras it is the half of middling height.
    """
    normal, centre = scene.plane.normal, scene.located.centre
    away = np.array([one.centre - centre for one in cameras if scene.plane.heights(one.centre) > 0.0]).reshape(-1, 3)
    if len(away) == 0:
        return None
    by_height = np.argsort(away @ normal / np.linalg.norm(away, axis=1), kind="stable")
    quarter = len(away) // 4
    return away[np.sort(by_height[quarter : len(away) - quarter])]
