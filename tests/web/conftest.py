"""One short run of a small pawn, shared by the tests of the page."""

from __future__ import annotations

from pathlib import Path

import pytest

from egs_warp.assets.pawn import pawn
from egs_warp.pipelines.animate import AnimateOptions, animate


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What ``egs-warp animate`` writes; twelve frames of a crouch."""
    folder = tmp_path_factory.mktemp("run")
    made = pawn(gaussian_count=6000)
    options = AnimateOptions(frames=12, size=64)
    animate(made.cloud, folder, plane=made.plane, options=options, source="pawn", quiet=True)
    return folder
