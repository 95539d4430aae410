"""Fixtures of the motion tests: a block that is posed by hand, and a simulated run that is shared by all tests."""

from __future__ import annotations

import pytest

from egs_warp.motions.sequence import Stance
from tests.support.runs import Run, coarse_block_run
from tests.support.stances import block_place


@pytest.fixture
def place() -> Stance:
    """Create the stance of a block of 0.4 x 0.4 x 1 m that stands on z = 0 and faces +x."""
    return block_place()


@pytest.fixture(scope="session")
def coarse_run() -> Run:
    """Simulate a block that hops onto a square half a metre ahead and then twists by 45 degrees."""
    return coarse_block_run("hop 0.5 0.25, twist 45")
