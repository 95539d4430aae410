"""Small changes of the code of a package, found by the operators of cosmic-ray, and the tests that ought to notice.

A place is a token that an operator would change; a package's sample is a seeded choice of places, with one change each.
Places are ranked by a digest of the seed and of the line they stand on, so that an edit elsewhere leaves the sample as
it is.
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
"""An operator changes into one of its family: a shift of floats would die of a TypeError, which shows nothing."""
_NO_KERNEL = frozenset(["RemoveDecorator", "ZeroIterationForLoop", "ExceptionReplacer"])
"""What Warp refuses to compile."""
_GUARDS = ("strict=True", "frozen=True", '"enable_backward": False')
"""Options that change no result of a right program."""


@dataclass(frozen=True)
class Change:
    """What one operator of cosmic-ray does at one place."""

    operator: str
    occurrence: int
    """Which of the places in the file at which the operator applies."""
    line: int
    """From 1."""


@dataclass(frozen=True)
class Mutant:
    """One change."""

    package: str
    file: str
    """Below the tree's root."""
    digest: str
    """Of the file's text."""
    operator: str
    """Of cosmic-ray."""
    occurrence: int
    """Which of the places in the file at which the operator applies."""
    line: int
    """From 1."""
    before: str
    after: str
    """The line, without its indent; nothing where the change takes it away."""

    @property
    def key(self) -> str:
        """Names the change as long as the file stays as it is."""
        return f"{self.file}:{self.digest}:{self.operator}:{self.occurrence}"

    @property
    def is_stale(self) -> bool:
        """Whether the file has been edited since."""
        return _digest((ROOT / self.file).read_text()) != self.digest

    def text(self) -> str:
        """The whole file, changed."""
        changed = _changed((ROOT / self.file).read_text(), self.operator, self.occurrence)
        assert changed is not None, f"{self.key} is no change"
        return changed


def files_of(package: str) -> list[Path]:
    """Of the package and of its kernels; fast tests see nothing of what runs on a GPU alone."""
    folders = (ROOT / "egs_warp" / package, ROOT / "egs_warp" / "kernels" / package)
    return sorted(
        path
        for folder in folders
        for path in folder.glob("*.py")
        if path.name != "__init__.py" and not path.stem.endswith("_cuda")
    )


def sample(package: str, count: int, seed: int) -> list[Mutant]:
    """At most ``count`` mutants of a package, at as many places, in the order of their ranks."""
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
    found: list[Mutant] = []
    for rank, path, source, changes in ranked:
        if len(found) == count:
            break
        mutant = _first_that_compiles(package, path, source, changes, rank)
        if mutant is not None:
            found.append(mutant)
    return found


def tests_of(package: str, file: str) -> list[str]:
    """The package's test files, ordered by their import distance to the changed module; the file named after it comes
    first.
    """
    module = file.removesuffix(".py").replace("/", ".")
    own = f"test_{Path(file).stem}"
    tests = (ROOT / "tests" / package).glob("test_*.py")
    nearest = sorted(tests, key=lambda path: (_distance(path, module), path.stem != own, path))
    return [path.relative_to(ROOT).as_posix() for path in nearest]


def _first_that_compiles(package: str, path: Path, source: str, changes: list[Change], rank: str) -> Mutant | None:
    """The change of a place whose turn it is by ``rank``, or the next that is Python and not the same program."""
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
    """(line, column) -> the changes that start there; none inside of annotations and guards."""
    operators = {name: one for name, one in _operators() if "kernels" not in path.parts or name not in _NO_KERNEL}
    counts = dict.fromkeys(operators, 0)
    untouched = [*_annotations(source), *_guards(source)]
    found: dict[tuple[int, int], list[Change]] = defaultdict(list)

    def walk(node: Any) -> None:
        # The star and the slash between parameters are no operators.
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
    """(line, column) of beginning and end of each."""
    lines = enumerate(source.splitlines(), start=1)
    hits = [(n, hit) for n, line in lines for guard in _GUARDS for hit in re.finditer(re.escape(guard), line)]
    return [((n, hit.start()), (n, hit.end())) for n, hit in hits]


def _annotations(source: str) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """(line, column) of beginning and end of each annotation: no program runs them."""
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
    """Those of cosmic-ray that need no arguments and stay within a family."""
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
    """How many imports lead from a file to a module; a large number where none do."""
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
    """Modules that a file imports anywhere; of a name from a package, the package and the module of that name."""
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
