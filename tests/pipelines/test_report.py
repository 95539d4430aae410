"""Sums in the report."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np

from egs_warp.locomotion.stepper import StepReport
from egs_warp.pipelines.report import StageTime, stage_times, versions


def test_a_frame_without_a_stage_spends_no_time_in_it() -> None:
    """Three frames consist of two, one and one steps, of which only the last replans."""
    spent = [{"predict": 3.0}, {"predict": 5.0}, {"predict": 1.0}, {"predict": 6.0, "replan": 9.0}]
    steps = [cast(StepReport, SimpleNamespace(milliseconds=stages)) for stages in spent]
    timing = stage_times(steps, np.array([0, 2, 3, 4]), {"render": [2.0, 4.0], "split": []})
    assert timing == {"predict": StageTime(5.0, 8.0), "replan": StageTime(3.0, 9.0), "render": StageTime(3.0, 4.0)}


def test_a_package_without_metadata_is_reported() -> None:
    """The package is missing, or was copied without its ``dist-info``."""
    told = versions(("numpy", "egs-warp-is-no-such-package"))
    assert told["numpy"] == np.__version__ and told["egs-warp-is-no-such-package"] == "no metadata"
