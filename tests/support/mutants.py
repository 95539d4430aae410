"""Mutants of a package, which are small changes by the operators of cosmic-ray, and the tests that should detect them.

A position is a token that an operator would change; the sample of a package is a seeded choice of positions, with one
change each. Positions are ranked by a digest of the seed and of their line, so that an edit elsewhere leaves the sample
unchanged.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import re
from collections import defaultdict
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
PACKAGES = ("contact", "locomotion", "fem", "deformation", "segmentation")
_ARITHMETIC = frozenset(["Add", "Sub", "Mul", "Div", "FloorDiv", "Mod", "Pow"])
_BITS = frozenset(["BitOr", "BitAnd", "BitXor"])
_ORDER = frozenset(["Eq", "NotEq", "Lt", "LtE", "Gt", "GtE"])
_IDENTITY = frozenset(["Is", "IsNot"])
_SIGNS = frozenset(["USub", "UAdd"])
_FAMILIES = (_ARITHMETIC, _BITS, _ORDER, _IDENTITY, _SIGNS)
"""Families of operators. An operator is replaced only by one of its own family, because a shift of floats, for example,
would raise a TypeError and so reveal nothing about the tests."""
_NO_KERNEL = frozenset(["RemoveDecorator", "ZeroIterationForLoop", "ExceptionReplacer"])
"""Operators of cosmic-ray whose changes Warp cannot compile."""
_GUARDS = ("strict=True", "frozen=True", '"enable_backward": False')
"""Options that do not change the results of a correct program and are therefore not mutated."""


@dataclass(frozen=True)
class Change:
    """Change by one operator of cosmic-ray at one position."""

    operator: str
    occurrence: int
    """Index among the positions in the file at which the operator applies."""
    line: int
    """Line number, counted from 1."""


@dataclass(frozen=True)
class Mutant:
    """Mutant: a change of one line of a file."""

    package: str
    file: str
    """Path relative to the root of the tree."""
    digest: str
    """Digest of the file's text."""
    operator: str
    """Name of the operator in cosmic-ray."""
    occurrence: int
    """Index among the positions in the file at which the operator applies."""
    line: int
    """Line number, counted from 1."""
    before: str
    after: str
    """The line without its indentation; empty if the change removes it."""

    @property
    def key(self) -> str:
        """Identifier of the change, valid while the file is unchanged."""
        return f"{self.file}:{self.digest}:{self.operator}:{self.occurrence}"

    @property
    def is_stale(self) -> bool:
        """True if the file has been edited since the mutant was made."""
        return _digest((ROOT / self.file).read_text()) != self.digest

    def text(self) -> str:
        """Return the text of the changed file."""
        changed = _changed((ROOT / self.file).read_text(), self.operator, self.occurrence)
        assert changed is not None, f"{self.key} is not a change"
        return changed


def files_of(package: str) -> list[Path]:
    """Return the files of the package and of its kernels, except those for GPUs, which fast tests skip."""
    folders = (ROOT / "egs_warp" / package, ROOT / "egs_warp" / "kernels" / package)
    return sorted(
        path
        for folder in folders
        for path in folder.glob("*.py")
        if path.name != "__init__.py" and not path.stem.endswith("_cuda")
    )


def sample(package: str, count: int, seed: int) -> list[Mutant]:
    """Return at most ``count`` mutants of a package, at as many positions, in the order of their ranks."""
    ranked = []
    for path in files_of(package):
        source = path.read_text()
        lines = source.splitlines()
        seen: dict[tuple[str, int], int] = defaultdict(int)
        for position, changes in sorted(_places(path, source).items()):
            line = lines[position[0] - 1]
            seen[line, position[1]] += 1
            rank = _rank(seed, path.relative_to(ROOT), line, position[1], seen[line, position[1]])
            ranked.append((rank, path, source, changes))
    ranked.sort(key=lambda entry: entry[0])
    mutants: list[Mutant] = []
    for rank, path, source, changes in ranked:
        if len(mutants) == count:
            break
        mutant = _first_that_compiles(package, path, source, changes, rank)
        if mutant is not None:
            mutants.append(mutant)
    return mutants


def tests_of(package: str, file: str) -> list[str]:
    """Return the package's test files, sorted by import distance to the changed module; the file named after it is
    first."""
    module = file.removesuffix(".py").replace("/", ".")
    own = f"test_{Path(file).stem}"
    tests = (ROOT / "tests" / package).glob("test_*.py")
    nearest = sorted(tests, key=lambda path: (_distance(path, module), path.stem != own, path))
    return [path.relative_to(ROOT).as_posix() for path in nearest]


def _first_that_compiles(package: str, path: Path, source: str, changes: list[Change], rank: str) -> Mutant | None:
    """Return the change that ``rank`` selects, or the next one that is valid Python and a different program."""
    start = int(rank[:8], 16) % len(changes)
    for change in changes[start:] + changes[:start]:
        changed = _changed(source, change.operator, change.occurrence)
        if changed is None or not _is_another_program(source, changed):
            continue
        lines = source.splitlines()
        if change.operator == "RemoveDecorator":
            number, before, after = change.line, lines[change.line - 1], ""
        else:
            pairs = enumerate(zip(lines, changed.splitlines(), strict=True), start=1)
            number, before, after = next((n, a, b) for n, (a, b) in pairs if a != b)
        place = path.relative_to(ROOT).as_posix()
        return Mutant(
            package, place, _digest(source), change.operator, change.occurrence, number, before.strip(), after.strip()
        )
    return None


def _is_another_program(source: str, changed: str) -> bool:
    try:
        return ast.dump(ast.parse(source)) != ast.dump(ast.parse(changed))
    except SyntaxError:
        return False


def _places(path: Path, source: str) -> dict[tuple[int, int], list[Change]]:
    """Return the changes by the (line, column) at which they begin, without those inside annotations and guards."""
    operators = {name: one for name, one in _operators() if "kernels" not in path.parts or name not in _NO_KERNEL}
    counts = dict.fromkeys(operators, 0)
    untouched = [*_annotations(source), *_guards(source)]
    found: dict[tuple[int, int], list[Change]] = defaultdict(list)

    def walk(node: Any) -> None:
        # The star and the slash between parameters are not operators.
        separator = node.parent is not None and node.parent.type in ("parameters", "lambdef")
        for name, operator in operators.items():
            for start, _ in operator.mutation_positions(node):
                if not separator and not any(first <= start < last for first, last in untouched):
                    found[start].append(Change(name, counts[name], start[0]))
                counts[name] += 1
        for child in getattr(node, "children", ()):
            walk(child)

    walk(importlib.import_module("cosmic_ray.ast").get_ast(source))
    return found


def _guards(source: str) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Return the start and the end, as (line, column), of each guard."""
    lines = enumerate(source.splitlines(), start=1)
    hits = [(n, hit) for n, line in lines for guard in _GUARDS for hit in re.finditer(re.escape(guard), line)]
    return [((n, hit.start()), (n, hit.end())) for n, hit in hits]


def _annotations(source: str) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Return the start and the end, as (line, column), of each annotation, because annotations are not executed."""
    nodes = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.arg | ast.AnnAssign):
            nodes.append(node.annotation)
        elif isinstance(node, ast.FunctionDef):
            nodes.append(node.returns)
    spans = [node for node in nodes if node is not None]
    return [((n.lineno, n.col_offset), (n.end_lineno or 0, n.end_col_offset or 0)) for n in spans]


@cache
def _operators() -> list[tuple[str, Any]]:
    """Return the names and classes of the operators of cosmic-ray that need no arguments and stay within a family."""
    provider = importlib.import_module("cosmic_ray.operators.provider").OperatorProvider()
    return [(name, provider[name]()) for name in provider if not provider[name].arguments() and _stays(name)]


def _stays(name: str) -> bool:
    if name.startswith("ReplaceUnaryOperator_Delete_"):
        return not name.endswith("USub")
    for kind in ("ReplaceBinaryOperator_", "ReplaceComparisonOperator_", "ReplaceUnaryOperator_"):
        if name.startswith(kind):
            first, second = name.removeprefix(kind).split("_")
            return any(first in family and second in family for family in _FAMILIES)
    return True


def _changed(source: str, operator: str, occurrence: int) -> str | None:
    mutating = importlib.import_module("cosmic_ray.mutating")
    return mutating.mutate_code(source, dict(_operators())[operator], occurrence)


def _digest(source: str) -> str:
    return hashlib.sha256(source.encode()).hexdigest()[:12]


def _rank(*parts: object) -> str:
    return hashlib.sha256("|".join(map(str, parts)).encode()).hexdigest()


def _distance(path: Path, module: str) -> int:
    """Return the number of imports from a file to a module; a large number if there is no path."""
    reached, edge, steps = {path}, [path], 0
    while edge:
        steps += 1
        names = set().union(*(_imports(file) for file in edge))
        if module in names:
            return steps
        edge = [file for file in map(_file_of, sorted(names)) if file is not None and file not in reached]
        reached.update(edge)
    return 10**6


@cache
def _imports(path: Path) -> frozenset[str]:
    """Return the modules that a file imports; for a name from a package, the package and the module of that name."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return frozenset(name for name in names if name.split(".")[0] in ("egs_warp", "tests"))


def _file_of(module: str) -> Path | None:
    path = ROOT / (module.replace(".", "/") + ".py")
    return path if path.is_file() else None
