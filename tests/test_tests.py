"""Structure of the tests: test files mirror the modules of the package, and share code only by ``tests/support``."""

from __future__ import annotations

import ast
from pathlib import Path

TESTS = Path(__file__).parent
ROOT = TESTS.parent
FILES = sorted(TESTS.rglob("test_*.py"))
ACROSS = {
    "io/test_antialiased.py",
    "io/test_by_hand.py",
    "io/test_errors.py",
    "io/test_ply_variants.py",
    "io/test_spark.py",
    "io/test_splat_transform.py",
    "meshing/test_body_frame.py",
    "motions/test_runs.py",
    "pipelines/test_invariance.py",
    "pipelines/test_python_api.py",
    "web/test_accessibility.py",
    "web/test_headset.py",
    "web/test_live_connection.py",
    "web/test_live_page.py",
    "web/test_page_controls.py",
    "web/test_page_picture.py",
    "web/test_react.py",
    "web/test_steered.py",
    "web/test_three_scene.py",
}
"""Test files for a whole package or for several modules."""


def imports(path: Path) -> set[str]:
    """Return the modules that a file imports, and the qualified names that it imports from them."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def test_no_test_file_imports_another() -> None:
    for path in FILES:
        from_tests = {name for name in imports(path) if name.split(".")[0] == "tests"}
        others = {name for name in from_tests if not name.startswith("tests.support.")}
        assert not others, f"{path.relative_to(TESTS)} imports {sorted(others)}; put what is shared into tests/support"


def test_each_test_file_is_named_after_a_module_of_its_package() -> None:
    for path in FILES:
        place = path.relative_to(TESTS)
        if len(place.parts) == 1 or place.as_posix() in ACROSS:
            continue
        module = place.parent / place.name.removeprefix("test_")
        home = ROOT if place.parts[0] == "benchmarks" else ROOT / "egs_warp"
        assert (home / module).is_file(), f"{place} tests no module: there is no {module}"
