"""The block that the motions are tried on."""

from __future__ import annotations

import pytest

from egs_warp.motions.sequence import Place
from tests.support.places import block_place


@pytest.fixture
def place() -> Place:
    """A block of 0.4 x 0.4 x 1 metres that stands on z = 0 and faces +x."""
    return block_place()
