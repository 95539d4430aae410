"""egs_warp animates still objects in 3D Gaussian Splatting captures (EnliveningGS, CVPR 2025) with Warp kernels.

``import egs_warp as egs`` provides all names below; each is imported at its first use.
"""

from __future__ import annotations

from importlib import import_module
from types import FunctionType
from typing import TYPE_CHECKING, Any

from egs_warp.version import __version__

if TYPE_CHECKING:
    from egs_warp.assets.box import box_cloud
    from egs_warp.assets.scene import BUILT_IN_SCENES, Scene, scene
    from egs_warp.commands.exit_handling import one_line_errors
    from egs_warp.contact.terrain import Solid
    from egs_warp.deformation.deformer import Deformer
    from egs_warp.deformation.embedding import embed_gaussians
    from egs_warp.environments.vector import CreatureVectorEnv
    from egs_warp.errors import ArgumentError, CaptureWarning, UserError
    from egs_warp.geometry.camera import Camera
    from egs_warp.geometry.gaussians import GaussianCloud, concatenate
    from egs_warp.geometry.height_field import HeightField
    from egs_warp.geometry.main_light import MainLight
    from egs_warp.geometry.plane import Plane
    from egs_warp.geometry.rigid_path import RigidPath
    from egs_warp.geometry.tetmesh import TetMesh
    from egs_warp.inpainting.holes import footprint
    from egs_warp.inpainting.inpaint import InpaintOptions, inpaint
    from egs_warp.inpainting.inpainters import Inpainter, inpainter_by_name
    from egs_warp.io.atomic import writable_folder
    from egs_warp.io.cameras import read_cameras
    from egs_warp.io.capture import Capture, read_capture
    from egs_warp.io.ply import write_ply
    from egs_warp.io.video import VideoWriter, contact_sheet, write_png
    from egs_warp.launching import use_device
    from egs_warp.locomotion.objectives import BodyPart
    from egs_warp.locomotion.settings import LocomotionSettings
    from egs_warp.locomotion.strategies import Strategy
    from egs_warp.locomotion.trajectory import Trajectory
    from egs_warp.motions.act import Act
    from egs_warp.motions.command import Drive
    from egs_warp.motions.gestures import Gesture
    from egs_warp.motions.keyframes import Channel, Key, Quantity
    from egs_warp.motions.push import Push, read_pushes
    from egs_warp.motions.script import Script, drive_script, keyframe_script, motion, own_script
    from egs_warp.motions.sequence import BodyMotion
    from egs_warp.motions.style import Style, read_style
    from egs_warp.pipelines.animate import AnimateOptions, animate
    from egs_warp.pipelines.animate_world import write_world
    from egs_warp.pipelines.creature import Creature, CreatureOptions, make_creature
    from egs_warp.pipelines.film import render_frames
    from egs_warp.pipelines.job import Job
    from egs_warp.pipelines.many import JobResult, WorldJobResult, simulate_many
    from egs_warp.pipelines.prepare_scene import PreparedScene, SceneOptions, prepare_scene
    from egs_warp.pipelines.prop import Footprint, Prop, make_prop
    from egs_warp.pipelines.report import Report
    from egs_warp.pipelines.shot import Shot
    from egs_warp.pipelines.simulated_run import SimulatedRun
    from egs_warp.pipelines.simulation import simulate
    from egs_warp.pipelines.train_capture import TrainResult, train
    from egs_warp.pipelines.world import PlacedBody, World
    from egs_warp.pipelines.world_file import WorldScript, read_world
    from egs_warp.pipelines.world_job import BodyOutcome, WorldJob
    from egs_warp.pipelines.world_report import WorldReport
    from egs_warp.pipelines.world_run import WorldRun
    from egs_warp.render.autograd import render_torch
    from egs_warp.render.rasteriser import render_gaussians
    from egs_warp.segmentation.clearance import ExtentMeasure, StraddlingOptions, StraddlingPolicy
    from egs_warp.segmentation.clicks import Click, click_at
    from egs_warp.segmentation.object_spec import Box, ObjectSpec
    from egs_warp.segmentation.votes import MaskedView
    from egs_warp.training.finetune import Densification, FinetuneOptions, LearningRates, finetune, render_views
    from egs_warp.training.metrics import psnr
    from egs_warp.training.training_view import TrainingView
    from egs_warp.web.notebook import show

_MODULES: dict[str, tuple[str, ...]] = {
    "assets.box": ("box_cloud",),
    "assets.scene": ("BUILT_IN_SCENES", "Scene", "scene"),
    "commands.exit_handling": ("one_line_errors",),
    "contact.terrain": ("Solid",),
    "deformation.deformer": ("Deformer",),
    "deformation.embedding": ("embed_gaussians",),
    "environments.vector": ("CreatureVectorEnv",),
    "errors": ("ArgumentError", "CaptureWarning", "UserError"),
    "geometry.camera": ("Camera",),
    "geometry.gaussians": ("GaussianCloud", "concatenate"),
    "geometry.height_field": ("HeightField",),
    "geometry.main_light": ("MainLight",),
    "geometry.plane": ("Plane",),
    "geometry.rigid_path": ("RigidPath",),
    "geometry.tetmesh": ("TetMesh",),
    "inpainting.holes": ("footprint",),
    "inpainting.inpaint": ("InpaintOptions", "inpaint"),
    "inpainting.inpainters": ("Inpainter", "inpainter_by_name"),
    "io.atomic": ("writable_folder",),
    "io.cameras": ("read_cameras",),
    "io.capture": ("Capture", "read_capture"),
    "io.ply": ("write_ply",),
    "io.video": ("VideoWriter", "contact_sheet", "write_png"),
    "launching": ("use_device",),
    "locomotion.objectives": ("BodyPart",),
    "locomotion.settings": ("LocomotionSettings",),
    "locomotion.strategies": ("Strategy",),
    "locomotion.trajectory": ("Trajectory",),
    "motions.act": ("Act",),
    "motions.command": ("Drive",),
    "motions.gestures": ("Gesture",),
    "motions.keyframes": ("Channel", "Key", "Quantity"),
    "motions.push": ("Push", "read_pushes"),
    "motions.script": ("Script", "drive_script", "keyframe_script", "motion", "own_script"),
    "motions.sequence": ("BodyMotion",),
    "motions.style": ("Style", "read_style"),
    "pipelines.animate": ("AnimateOptions", "animate"),
    "pipelines.animate_world": ("write_world",),
    "pipelines.creature": ("Creature", "CreatureOptions", "make_creature"),
    "pipelines.film": ("render_frames",),
    "pipelines.job": ("Job",),
    "pipelines.many": ("JobResult", "WorldJobResult", "simulate_many"),
    "pipelines.simulated_run": ("SimulatedRun",),
    "pipelines.simulation": ("simulate",),
    "pipelines.prepare_scene": ("PreparedScene", "SceneOptions", "prepare_scene"),
    "pipelines.prop": ("Footprint", "Prop", "make_prop"),
    "pipelines.report": ("Report",),
    "pipelines.shot": ("Shot",),
    "pipelines.train_capture": ("TrainResult", "train"),
    "pipelines.world": ("PlacedBody", "World"),
    "pipelines.world_file": ("WorldScript", "read_world"),
    "pipelines.world_job": ("BodyOutcome", "WorldJob"),
    "pipelines.world_report": ("WorldReport",),
    "pipelines.world_run": ("WorldRun",),
    "render.autograd": ("render_torch",),
    "render.rasteriser": ("render_gaussians",),
    "segmentation.clearance": ("StraddlingPolicy", "StraddlingOptions", "ExtentMeasure"),
    "segmentation.clicks": ("Click", "click_at"),
    "segmentation.object_spec": ("Box", "ObjectSpec"),
    "segmentation.votes": ("MaskedView",),
    "training.finetune": ("Densification", "FinetuneOptions", "LearningRates", "finetune", "render_views"),
    "training.metrics": ("psnr",),
    "training.training_view": ("TrainingView",),
    "web.notebook": ("show",),
}
"""Module of each public name; the imports above declare the same for type checkers."""
_MODULE_OF = {name: f"egs_warp.{module}" for module, names in _MODULES.items() for name in names}

__all__ = [
    "BUILT_IN_SCENES",
    "Act",
    "AnimateOptions",
    "ArgumentError",
    "BodyMotion",
    "BodyOutcome",
    "BodyPart",
    "Box",
    "Camera",
    "Capture",
    "CaptureWarning",
    "Channel",
    "Click",
    "Creature",
    "CreatureOptions",
    "CreatureVectorEnv",
    "Deformer",
    "Densification",
    "Drive",
    "ExtentMeasure",
    "FinetuneOptions",
    "Footprint",
    "GaussianCloud",
    "Gesture",
    "HeightField",
    "InpaintOptions",
    "Inpainter",
    "Job",
    "JobResult",
    "Key",
    "LearningRates",
    "LocomotionSettings",
    "MainLight",
    "MaskedView",
    "ObjectSpec",
    "PlacedBody",
    "Plane",
    "PreparedScene",
    "Prop",
    "Push",
    "Quantity",
    "Report",
    "RigidPath",
    "Scene",
    "SceneOptions",
    "Script",
    "Shot",
    "SimulatedRun",
    "Solid",
    "StraddlingOptions",
    "StraddlingPolicy",
    "Strategy",
    "Style",
    "TetMesh",
    "TrainResult",
    "TrainingView",
    "Trajectory",
    "UserError",
    "VideoWriter",
    "World",
    "WorldJob",
    "WorldJobResult",
    "WorldReport",
    "WorldRun",
    "WorldScript",
    "__version__",
    "animate",
    "box_cloud",
    "click_at",
    "concatenate",
    "contact_sheet",
    "drive_script",
    "embed_gaussians",
    "finetune",
    "footprint",
    "inpaint",
    "inpainter_by_name",
    "keyframe_script",
    "make_creature",
    "make_prop",
    "motion",
    "one_line_errors",
    "own_script",
    "prepare_scene",
    "psnr",
    "read_cameras",
    "read_capture",
    "read_pushes",
    "read_style",
    "read_world",
    "render_frames",
    "render_gaussians",
    "render_torch",
    "render_views",
    "scene",
    "show",
    "simulate",
    "simulate_many",
    "train",
    "use_device",
    "writable_folder",
    "write_ply",
    "write_png",
    "write_world",
]


RETURNED_BY = {
    "Capture": "read_capture",
    "Click": "click_at",
    "Creature": "make_creature",
    "GaussianCloud": "read_capture",
    "GaussianEmbedding": "embed_gaussians",
    "Hole": "footprint",
    "Inpainter": "inpainter_by_name",
    "PreparedScene": "prepare_scene",
    "Prop": "make_prop",
    "Scene": "scene",
    "Script": "motion",
    "SimulatedRun": "simulate",
    "Style": "read_style",
    "WorldRun": "simulate",
    "WorldScript": "read_world",
}
"""Public function that returns an object of each class, for messages."""


def callables_with(argument: str) -> list[str]:
    """Return the functions and options dataclasses with this argument, of those that the program has used."""
    from inspect import signature

    from egs_warp.checked_calls import is_options

    used = {name: globals()[name] for name in sorted(__all__) if name in globals()}
    found = [
        name
        for name, one in used.items()
        if (isinstance(one, FunctionType) or is_options(one)) and argument in signature(one).parameters
    ]
    if argument in import_module("egs_warp.motions.repertoire").parameter_names():
        found.insert(0, "motion")
    return found


def __getattr__(name: str) -> Any:
    """Import and return the public ``name`` (PEP 562); functions check their arguments."""
    if name not in _MODULE_OF:
        from egs_warp.errors import did_you_mean

        # Not every Python version and shell suggests a similar name, and they only do so in a traceback.
        near = "" if name.startswith("_") else did_you_mean(name, __all__)
        raise AttributeError(f"module 'egs_warp' has no attribute {name!r}{near}", name=name)
    value = getattr(import_module(_MODULE_OF[name]), name)
    if isinstance(value, FunctionType):
        from egs_warp.checked_calls import checked_function

        value = checked_function(value)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
