"""Fixtures of all tests: devices, a browser, coarse bodies, a finished run, and the folder of real captures."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import warp as wp
from hypothesis import settings

from tests.support.properties import example_lines

wp.config.log_level = wp.LOG_WARNING
# By default, every test run has the same Hypothesis examples, without a time limit. ``make fuzz`` sets
# HYPOTHESIS_PROFILE=fuzz: the examples are random, and there are ten times as many. For a failing example, the @example
# line to add to the test is printed at the end of the output.
settings.register_profile("fixed", derandomize=True, database=None, deadline=None)
settings.register_profile("fuzz", derandomize=False, database=None, deadline=None, max_examples=1000, print_blob=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "fixed"))

_DATA = Path(os.environ.get("EGS_WARP_DATA", Path(__file__).parents[2] / "shared" / "data"))

_LONG_FIRST = ("pipelines", "segmentation", "inpainting", "locomotion", "meshing", "commands", "assets", "web")
"""Folders of the slowest tests, which run first."""


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Skip, with the reason, tests that this machine cannot run; put folders of slow tests first."""
    items.sort(key=lambda item: item.path.parent.name not in _LONG_FIRST)
    no_data = pytest.mark.skip(reason=f"real captures not found in {_DATA}; set EGS_WARP_DATA")
    no_cuda = pytest.mark.skip(reason="no CUDA device")
    for item in items:
        if "data" in item.keywords and not _DATA.is_dir():
            item.add_marker(no_data)
        if "cuda" in item.keywords and not wp.is_cuda_available():
            item.add_marker(no_cuda)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the failing examples of Hypothesis as decorators to paste above the tests."""
    for report in terminalreporter.stats.get("failed", []):
        for line in example_lines(report.longreprtext):
            terminalreporter.write_line(f"add to {report.nodeid}:\n    {line}")


@pytest.fixture(autouse=True)
def no_scene_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable the cache of prepared scenes, which belongs to the user."""
    monkeypatch.setenv("EGS_WARP_CACHE", "")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Return the folder of real captures; tests that use it have the marker ``data``."""
    return _DATA


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """Start one browser for all tests, because Playwright can be started only once in a process."""
    from tests.support.chromium import started

    with started() as browser:
        yield browser


@pytest.fixture(params=["cpu", pytest.param("cuda:0", marks=pytest.mark.cuda)])
def device(request: pytest.FixtureRequest) -> str:
    """Return the name of each Warp device in turn."""
    return request.param


@pytest.fixture
def coarse() -> Iterator[None]:
    """Make ``animate`` build bodies of about 200 nodes, whose steps take half the time of the default 500 nodes."""
    from tests.support.coarse import coarse_cages

    with coarse_cages(120):
        yield


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder written by ``egs-warp animate``: thirteen images of a small, coarse pawn that crouches."""
    from egs_warp.assets.pawn import pawn
    from egs_warp.pipelines.animate import AnimateOptions, animate
    from tests.support.coarse import coarse_cages

    folder = tmp_path_factory.mktemp("run")
    made = pawn(gaussian_count=6000)
    options = AnimateOptions(frames=13, size=64, source="pawn")
    with coarse_cages(120):
        animate(made.cloud, folder, plane=made.plane, options=options, quiet=True)
    return folder
