"""Scenes made by the package: nothing to download."""

from egs_warp.scenes.object import BuiltInObject
from egs_warp.scenes.pawn import pawn

__all__ = ["BuiltInObject", "pawn"]
