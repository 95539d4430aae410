"""``python -m tests.support.coarse animate ...``: the command on coarse cages, so that a whole run takes seconds."""

from __future__ import annotations

import os
import sys
from functools import partial
from unittest.mock import patch

from egs_warp.cli import main
from egs_warp.pipelines.creature import make_creature

NODES = 60
"""Where ``EGS_WARP_TEST_NODES`` does not say otherwise."""

if __name__ == "__main__":
    nodes = int(os.environ.get("EGS_WARP_TEST_NODES", NODES))
    with patch("egs_warp.pipelines.animate.make_creature", partial(make_creature, nodes=nodes)):
        sys.exit(main())
