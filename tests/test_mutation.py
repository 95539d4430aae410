"""Mutation testing: the mutants, the continuation of an interrupted run, and the list of survivors."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.support import mutants, mutation
from tests.support.surviving_mutants import SURVIVORS
from tests.support.surviving_mutants.survivor import Survivor

pytest.importorskip("cosmic_ray", reason="cosmic-ray is part of the dev extra")
SOURCE = """
from dataclasses import dataclass


@dataclass(frozen=True)
class Pair:
    first: int | None = 1


def larger(pair: Pair | None, *, floor: float = 0.5) -> float | None:
    if pair is None or pair.first is None:
        return -floor
    return max((a + b for a, b in zip([pair.first], [floor], strict=True)), default=0.0)
"""


@pytest.fixture
def room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Create a tree whose package ``contact`` consists of one small file; return the file."""
    file = tmp_path / "egs_warp" / "contact" / "pair.py"
    file.parent.mkdir(parents=True)
    file.write_text(SOURCE)
    monkeypatch.setattr(mutants, "ROOT", tmp_path)
    return file


def test_changes_are_other_programs_within_a_family(room: Path) -> None:
    """Mutants are valid programs, without changes in annotations and guards; ``+`` is never replaced by a shift."""
    found = mutants.sample("contact", 100, 1)
    assert len({(mutant.line, mutant.before, mutant.after) for mutant in found}) == len(found) >= 8
    for mutant in found:
        compile(mutant.text(), mutant.file, "exec")
        assert mutant.text() != SOURCE and mutant.file == "egs_warp/contact/pair.py"
        assert mutant.before in SOURCE.splitlines()[mutant.line - 1]
        assert not {"<<", ">>", "~"} & set(mutant.after.split()), mutant.after
    after = " ".join(mutant.after for mutant in found)
    assert (
        "Pair | None, *, floor" in after
        and ", /, floor" not in after
        and "frozen=False" not in after
        and "strict=False" not in after
    )


def test_a_sample_does_not_depend_on_other_lines(room: Path) -> None:
    few = mutants.sample("contact", 4, 1)
    assert few == mutants.sample("contact", 100, 1)[:4] != mutants.sample("contact", 4, 2)
    room.write_text(SOURCE + "\n\ndef another(a: float) -> float:\n    return a * 2.0\n")
    more = [mutant for mutant in mutants.sample("contact", 100, 1) if "2.0" not in mutant.before]
    assert [(m.before, m.after) for m in more[:4]] == [(m.before, m.after) for m in few]


def test_an_edited_file_has_no_mutants_of_its_old_text(room: Path) -> None:
    (mutant,) = mutants.sample("contact", 1, 1)
    assert not mutant.is_stale
    room.write_text(SOURCE + "\n# edited\n")
    assert mutant.is_stale


@pytest.mark.slow
def test_the_nearest_test_comes_first() -> None:
    """Tests are ordered by the number of imports between the test and the module, where host code counts as importing
    its kernels. The test of the module itself comes first."""
    nearest = ["tests/contact/test_selection.py", "tests/contact/test_batch_step.py"]
    assert mutants.tests_of("contact", "egs_warp/contact/selection.py")[:2] == nearest
    assert mutants.tests_of("fem", "egs_warp/kernels/fem/elasticity.py")[0] == "tests/fem/test_simd_elasticity.py"
    for chosen in mutants.PACKAGES:
        assert len(mutants.tests_of(chosen, "")) == len(list((mutants.ROOT / "tests" / chosen).glob("test_*.py"))) > 3


@pytest.mark.slow
def test_an_interrupted_run_continues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Results are written one by one; survivors are tested again on request."""
    tried: list[str] = []

    def fake(self: mutation.Copy, tests: list[str], limit: float) -> mutation.Outcome:
        changed = [path for path in mutants.files_of("fem") if _differs(self, path)]
        tried.extend(path.name for path in changed)
        survives = not changed or len(tried) % 3 == 0
        return mutation.Outcome("survived" if survives else "assertion", 1.0, "" if survives else tests[0])

    monkeypatch.setattr(mutation.Copy, "run", fake)
    monkeypatch.setattr(mutation.Copy, "keep_kernels", lambda self, kernels: kernels.mkdir(parents=True))
    monkeypatch.setattr(mutation, "OUT", tmp_path)

    def run(*extra: str) -> int:
        session, survivors = str(tmp_path / "session.jsonl"), str(tmp_path / "survivors.json")
        command = ["mutation", "--packages", "fem", "--count", "6", "--session", session, "--json", survivors, *extra]
        monkeypatch.setattr("sys.argv", command)
        return mutation.main()

    assert run("--minutes", "0") == 0 and not tried
    assert run() == 1 and len(tried) == 6
    survivors = json.loads((tmp_path / "survivors.json").read_text())
    assert len(survivors) == 2 and {"file", "line", "before", "after", "no gap"} <= set(survivors[0])
    assert run() == 1 and len(tried) == 6
    assert run("--again", "--processes", "2") == 0 and len(tried) == 8


def _differs(copy: mutation.Copy, path: Path) -> bool:
    return (copy.folder / path.relative_to(mutants.ROOT)).read_text() != path.read_text()


@pytest.mark.parametrize("survivor", SURVIVORS, ids=lambda survivor: survivor.before)
def test_survivors_refer_to_existing_lines(survivor: Survivor) -> None:
    """When a line is rewritten, its entries must be removed from the list of survivors."""
    lines = [line.strip() for line in (mutants.ROOT / "egs_warp" / survivor.file).read_text().splitlines()]
    assert survivor.before in lines and len(survivor.reason) > 20
