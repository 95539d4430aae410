"""``docs/equations.md`` is complete: names exist, cited tests name their equation,
no equation of a docstring is missing.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "equations.md").read_text()
JOIN = r"(?:\s*-\s*|\s+to\s+|\s+and\s+|,\s*)"
MENTION = re.compile(rf"Eq\.\s*(\(\d+\)(?:{JOIN}\(\d+\))*|\(?\d+(?:{JOIN}\d+)*)")


def table(text: str) -> dict[int, str]:
    """Equation -> its row."""
    rows = [line for line in text.splitlines() if re.match(r"\| \d+ \|", line)]
    numbers = [int(line.split("|")[1]) for line in rows]
    assert len(set(numbers)) == len(numbers), "an equation has two rows"
    return dict(zip(numbers, rows, strict=True))


def mentioned(text: str | None) -> set[int]:
    """Numbers of "Eq. (9), (13)", "Eq. (14) to (16)", "Eq. 4, 6" and "Eq. 8-10"."""
    numbers: set[int] = set()
    for found in MENTION.findall(text or ""):
        for part in re.split(r",|\band\b", found):
            ends = [int(end) for end in re.findall(r"\d+", part)]
            numbers.update(range(ends[0], ends[-1] + 1))
    return numbers


def definitions(path: Path) -> dict[str, str]:
    """Qualified name -> docstring of every function and class of a file; the module's own under ""."""
    tree = ast.parse(path.read_text())
    found = {"": ast.get_docstring(tree) or ""}

    def visit(node: ast.AST, prefix: str) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef | ast.ClassDef):
                found[prefix + child.name] = ast.get_docstring(child) or ""
                visit(child, prefix + child.name + ".")

    visit(tree, "")
    return found


ROWS = table(PAGE)


def test_the_reader_of_mentions_reads_lists_and_ranges() -> None:
    assert mentioned("(Eq. 4, 6) and Eq. (9), Eq. 14-16; Tan 2012") == {4, 6, 9, 14, 15, 16}
    assert mentioned("Eq. (14) to (16): x. Eq. (2), (3): y, 5") == {2, 3, 14, 15, 16}
    assert mentioned("no equation") == set()


def test_every_equation_of_the_paper_has_a_row() -> None:
    assert sorted(ROWS) == list(range(1, 22))


def test_every_place_exists() -> None:
    for number, row in ROWS.items():
        places = re.findall(r"`(egs_warp/[\w/]+\.py):([\w.]+)`", row)
        assert places, f"Eq. ({number}) names no function"
        for file, name in places:
            assert (ROOT / file).is_file(), f"Eq. ({number}): {file} does not exist"
            assert name in definitions(ROOT / file), f"Eq. ({number}): {file} has no {name}"


def test_every_test_exists_and_names_its_equation() -> None:
    for number, row in ROWS.items():
        tests = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", row)
        assert tests, f"Eq. ({number}) has no test"
        for file, name in tests:
            known = definitions(ROOT / file)
            assert name in known, f"Eq. ({number}): {file} has no {name}"
            assert number in mentioned(known[name]) | mentioned(known[""]), (
                f"{file}::{name} does not say Eq. ({number})"
            )


def test_every_equation_that_the_package_mentions_has_a_row() -> None:
    for path in sorted((ROOT / "egs_warp").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                missing = mentioned(node.value) - set(ROWS)
                assert not missing, f"{path.relative_to(ROOT)} mentions Eq. {sorted(missing)}, not in docs/equations.md"
