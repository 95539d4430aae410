"""Entry point of ``python -m egs_warp``, which runs ``egs-warp`` even if the folder of that command is not on the
PATH."""

import sys

from egs_warp.cli import main

sys.exit(main())
