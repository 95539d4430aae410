"""Scenes made by the package: nothing to download."""

from egs_warp.scenes.figurine import figurine
from egs_warp.scenes.object import BuiltInObject
from egs_warp.scenes.pawn import pawn
from egs_warp.scenes.stool import stool

__all__ = ["BuiltInObject", "figurine", "pawn", "stool"]
