"""Scenes made by the package: nothing to download."""

from egs_warp.scenes.figurine import figurine
from egs_warp.scenes.object import BuiltInObject
from egs_warp.scenes.pawn import pawn
from egs_warp.scenes.rooms import SQUARE
from egs_warp.scenes.scene import BUILT_IN_SCENES, Scene, scene
from egs_warp.scenes.stool import stool

__all__ = ["BUILT_IN_SCENES", "SQUARE", "BuiltInObject", "Scene", "figurine", "pawn", "scene", "stool"]
