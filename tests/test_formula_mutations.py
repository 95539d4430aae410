"""Check that the test listed with each deliberately wrong formula of ``tests/support/mutations.py`` fails with that
formula."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.mutations import ALL, EQUATIONS, Mutation

ROOT = Path(__file__).parents[1]
by_formula = pytest.mark.parametrize("mutation", ALL, ids=lambda mutation: mutation.what)


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of the package and its tests, which is to be mutated. Without a mutation, all listed tests pass."""
    folder = tmp_path_factory.mktemp("spoiled")
    shutil.copy(ROOT / "pyproject.toml", folder)
    for name in ("egs_warp", "tests", "benchmarks/contact_states"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    tests = sorted({mutation.test for mutation in ALL})
    right = run_tests(folder, *tests)
    assert right.returncode == 0, f"a test fails with the right formulas\n{right.stdout}"
    return folder


def run_tests(folder: Path, *tests: str) -> subprocess.CompletedProcess[str]:
    """Run tests of the package in ``folder`` until one fails."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "--tb=native", "-p", "no:cacheprovider", *tests]
    environment = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=1800)


def test_every_equation_of_the_paper_is_spoiled_once() -> None:
    assert sorted(EQUATIONS) == list(range(1, 22))


@by_formula
def test_each_formula_occurs_once(mutation: Mutation) -> None:
    """The text of each formula occurs only once in its file, so that the right one is changed, and the test that must
    fail exists."""
    found = (ROOT / mutation.file).read_text().count(mutation.right)
    assert found == 1, f"{mutation.file} has {found} times: {mutation.right}; rewrite the mutation with the formula"
    file, name = mutation.test.split("::")
    assert f"\ndef {name}(" in (ROOT / file).read_text(), f"{mutation.test} does not exist"


@pytest.mark.slow
@by_formula
def test_a_wrong_formula_is_detected(copy: Path, mutation: Mutation) -> None:
    """The test fails by an assertion, not because the mutated program cannot run."""
    place = copy / mutation.file
    right = place.read_text()
    place.write_text(right.replace(mutation.right, mutation.wrong))
    try:
        run = run_tests(copy, mutation.test)
    finally:
        place.write_text(right)
    assert run.returncode == 1 and "AssertionError" in run.stdout, f"{mutation.test} does not fail\n{run.stdout}"
