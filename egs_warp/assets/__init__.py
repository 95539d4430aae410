"""Objects and rooms made by the package, to try the whole paper on: nothing to download.

In: a name, a seed. Out: a cloud, its plane and cameras.
"""

from egs_warp.assets.environments import SQUARE
from egs_warp.assets.figurine import figurine
from egs_warp.assets.object import BuiltInObject
from egs_warp.assets.pawn import pawn
from egs_warp.assets.scene import BUILT_IN_SCENES, Scene, scene
from egs_warp.assets.snake import snake
from egs_warp.assets.stool import stool

__all__ = ["BUILT_IN_SCENES", "SQUARE", "BuiltInObject", "Scene", "figurine", "pawn", "scene", "snake", "stool"]
