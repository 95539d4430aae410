"""Built-in scenes, generated procedurally, to try every stage of the paper without downloading data.

Input: a name and a seed. Output: a Gaussian cloud, its plane and a camera.
"""

from egs_warp.assets.box import box_cloud
from egs_warp.assets.environments import SQUARE
from egs_warp.assets.figurine import figurine
from egs_warp.assets.object import BuiltInObject
from egs_warp.assets.pawn import pawn
from egs_warp.assets.scene import BUILT_IN_SCENES, Scene, scene
from egs_warp.assets.snake import snake
from egs_warp.assets.stool import stool

__all__ = [
    "BUILT_IN_SCENES",
    "SQUARE",
    "BuiltInObject",
    "Scene",
    "box_cloud",
    "figurine",
    "pawn",
    "scene",
    "snake",
    "stool",
]
