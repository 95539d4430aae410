"""The block for the tests of the motions: posed by hand, or simulated once for all tests."""

from __future__ import annotations

import pytest

from egs_warp.motions.sequence import Stance
from tests.support.runs import Run, coarse_block_run
from tests.support.stances import block_place


@pytest.fixture
def place() -> Stance:
    """A block of 0.4 x 0.4 x 1 metres that stands on z = 0 and faces +x."""
    return block_place()


@pytest.fixture(scope="session")
def coarse_run() -> Run:
    """A run of a block that hops onto a square half a metre ahead and then twists by 45 degrees."""
    return coarse_block_run("hop 0.5 0.25, twist 45")
