"""``python -m tests.support.coarse animate ...``: the command on coarse cages, so that a whole run takes seconds."""

from __future__ import annotations

import sys
from functools import partial
from unittest.mock import patch

from egs_warp.cli import main
from egs_warp.pipelines.creature import make_creature

NODES = 60

if __name__ == "__main__":
    with patch("egs_warp.pipelines.animate.make_creature", partial(make_creature, nodes=NODES)):
        sys.exit(main())
