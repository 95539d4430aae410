"""Completeness and correctness of ``docs/equations.md``: all names exist, no equation that a docstring mentions is
missing, and cited tests test their equation.

A cited test must mention the equation and call the code of its row. For each equation, ``tests/support/mutations.py``
has a wrong formula with which one of the row's tests fails (``tests/test_formula_mutations.py``).
"""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from tests.support.mutations import EQUATIONS

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "equations.md").read_text()
JOIN = r"(?:\s*-\s*|\s+to\s+|\s+and\s+|,\s*)"
MENTION = re.compile(rf"Eq\.\s*(\(\d+\)(?:{JOIN}\(\d+\))*|\(?\d+(?:{JOIN}\d+)*)")


def table(text: str) -> dict[int, str]:
    """Return the row of each equation by its number."""
    rows = [line for line in text.splitlines() if re.match(r"\| \d+ \|", line)]
    numbers = [int(line.split("|")[1]) for line in rows]
    assert len(set(numbers)) == len(numbers), "an equation has two rows"
    return dict(zip(numbers, rows, strict=True))


def mentioned(text: str | None) -> set[int]:
    """Return the numbers in "Eq. (9), (13)", "Eq. (14) to (16)", "Eq. 4, 6" and "Eq. 8-10"."""
    numbers: set[int] = set()
    for found in MENTION.findall(text or ""):
        for part in re.split(r",|\band\b", found):
            ends = [int(end) for end in re.findall(r"\d+", part)]
            numbers.update(range(ends[0], ends[-1] + 1))
    return numbers


def definitions(path: Path) -> dict[str, str]:
    """Return the docstring of every function and class of a file by qualified name, and the module's under ""."""
    tree = ast.parse(path.read_text())
    found = {"": ast.get_docstring(tree) or ""}

    def visit(node: ast.AST, prefix: str) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef | ast.ClassDef):
                found[prefix + child.name] = ast.get_docstring(child) or ""
                visit(child, prefix + child.name + ".")

    visit(tree, "")
    return found


@dataclass
class Reached:
    """Definitions that a test uses directly or indirectly."""

    definitions: set[tuple[Path, str]] = field(default_factory=set)
    """File and name of each function, class or variable."""
    words: set[str] = field(default_factory=set)
    """All names and attributes that occur in these definitions."""


@cache
def contents(path: Path) -> tuple[dict[str, ast.stmt], dict[str, tuple[Path, str]]]:
    """Return the definitions of a file by name, and the origin (file, name) of its imports."""
    defined: dict[str, ast.stmt] = {}
    imported: dict[str, tuple[Path, str]] = {}
    tree = ast.parse(path.read_text())
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            defined[node.name] = node
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                defined.update({part.id: node for part in ast.walk(target) if isinstance(part, ast.Name)})
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in ("egs_warp", "tests"):
            base = ROOT.joinpath(*node.module.split("."))
            file = base / "__init__.py" if base.is_dir() else base.with_suffix(".py")
            imported.update({alias.asname or alias.name: (file, alias.name) for alias in node.names})
    return defined, imported


def names_reached(path: Path, name: str) -> Reached:
    """Return the definitions that a test reaches by calls, fixtures, imports and re-exports, within the package and its
    tests."""
    reached, open_ends = Reached(), [(path, name)]
    while open_ends:
        path, name = open_ends.pop()
        if (path, name) in reached.definitions or not path.is_file():
            continue
        defined, imported = contents(path)
        if name in imported:
            open_ends.append(imported[name])
        if name not in defined:
            continue
        reached.definitions.add((path, name))
        for node in ast.walk(defined[name]):
            word = {ast.Name: "id", ast.Attribute: "attr", ast.arg: "arg"}.get(type(node))
            if word:
                reached.words.add(getattr(node, word))
                open_ends.append((path, getattr(node, word)))
            elif isinstance(node, ast.Assert):
                reached.words.add("assert")
        reached.words.add(name)
    return reached


ROWS = table(PAGE)
PLACE = re.compile(r"`(egs_warp/[\w/]+\.py):([\w.]+)`")
TEST = re.compile(r"`(tests/[\w/]+\.py)::(\w+)`")


def test_mentioned_reads_lists_and_ranges() -> None:
    assert mentioned("(Eq. 4, 6) and Eq. (9), Eq. 14-16; Tan 2012") == {4, 6, 9, 14, 15, 16}
    assert mentioned("Eq. (14) to (16): x. Eq. (2), (3): y, 5") == {2, 3, 14, 15, 16}
    assert mentioned("no equation") == set()


def test_every_equation_of_the_paper_has_a_row() -> None:
    assert sorted(ROWS) == list(range(1, 22))


def test_every_place_exists() -> None:
    for number, row in ROWS.items():
        places = PLACE.findall(row)
        assert places, f"Eq. ({number}) names no function"
        for file, name in places:
            assert (ROOT / file).is_file(), f"Eq. ({number}): {file} does not exist"
            assert name in definitions(ROOT / file), f"Eq. ({number}): {file} has no {name}"


def test_every_test_exists_and_names_its_equation() -> None:
    for number, row in ROWS.items():
        tests = TEST.findall(row)
        assert tests, f"Eq. ({number}) has no test"
        for file, name in tests:
            known = definitions(ROOT / file)
            assert name in known, f"Eq. ({number}): {file} has no {name}"
            assert number in mentioned(known[name]) | mentioned(known[""]), (
                f"{file}::{name} does not say Eq. ({number})"
            )


def test_every_cited_test_asserts_and_calls_the_code_of_its_row() -> None:
    for number, row in ROWS.items():
        places = PLACE.findall(row)
        for file, name in TEST.findall(row):
            reached = names_reached(ROOT / file, name)
            assert {"assert", "raises"} & reached.words or any(w.startswith("assert") for w in reached.words), (
                f"{file}::{name} asserts nothing"
            )
            called = [
                place
                for place in places
                if (ROOT / place[0], place[1].split(".")[0]) in reached.definitions
                and place[1].split(".")[-1] in reached.words
            ]
            assert called, f"{file}::{name} calls none of {places}, so it is no test of Eq. ({number})"


def test_calls_are_followed_through_helpers_and_mentions_do_not_count(tmp_path: Path) -> None:
    file = tmp_path / "test_it.py"
    file.write_text(
        "from egs_warp.segmentation.plane_fit import fit_plane\n"
        "from egs_warp.render import render_gaussians\n"
        "def helper():\n    return fit_plane([])\n"
        'def test_mentions():\n    """Eq. (19) fit_plane"""\n    assert True\n'
        "def test_calls():\n    assert helper()\n"
    )
    place = (ROOT / "egs_warp/segmentation/plane_fit.py", "fit_plane")
    assert place in names_reached(file, "test_calls").definitions
    assert place not in names_reached(file, "test_mentions").definitions


def test_every_equation_has_a_test_that_a_wrong_formula_fails() -> None:
    for number, row in ROWS.items():
        mutation = EQUATIONS[number]
        # The wrong formula may be in a function that the code of the row calls.
        assert mutation.file in {file for file, _ in PLACE.findall(row)}, (
            f"Eq. ({number}): {mutation.file} is not in its row"
        )
        assert tuple(mutation.test.split("::")) in TEST.findall(row), (
            f"Eq. ({number}): {mutation.test} is not in its row"
        )


def test_every_equation_that_the_package_mentions_has_a_row() -> None:
    for path in sorted((ROOT / "egs_warp").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                missing = mentioned(node.value) - set(ROWS)
                assert not missing, f"{path.relative_to(ROOT)} mentions Eq. {sorted(missing)}, not in docs/equations.md"
