"""Program ``egs-warp`` with coarse cages, so that a whole run takes seconds (``python -m tests.support.coarse animate
...``)."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any
from unittest.mock import patch

from egs_warp.cli import main
from egs_warp.pipelines.creature import Creature, CreatureOptions, make_checked_creature

NODES = 60
"""Number of nodes if ``EGS_WARP_TEST_NODES`` is not set."""


def coarse_maker(nodes: int) -> Callable[..., Creature]:
    """Return ``make_checked_creature`` with cages of about ``nodes`` nodes."""

    def make_coarse_creature(*arguments: Any, options: CreatureOptions, **named: Any) -> Creature:
        return make_checked_creature(*arguments, options=replace(options, nodes=nodes), **named)

    return make_coarse_creature


@contextmanager
def coarse_cages(nodes: int) -> Iterator[None]:
    """Make ``animate`` build cages of about ``nodes`` nodes."""
    with patch("egs_warp.pipelines.animate.make_checked_creature", coarse_maker(nodes)):
        yield


def coarse_main(arguments: Sequence[str] | None = None) -> int:
    """Run ``egs-warp`` with coarse cages; return the exit status. ``arguments`` default to those of the process."""
    with coarse_cages(int(os.environ.get("EGS_WARP_TEST_NODES", NODES))):
        return main(arguments)


if __name__ == "__main__":
    sys.exit(coarse_main())
