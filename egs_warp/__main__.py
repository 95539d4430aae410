"""``python -m egs_warp``: the command ``egs-warp`` where its folder of scripts is not on the path."""

import sys

from egs_warp.cli import main

sys.exit(main())
