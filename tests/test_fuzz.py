"""Short form of ``make fuzz``: for any bytes, a reader returns a valid object or raises a one-line error."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.support import readers
from tests.support.corruption import damaged
from tests.support.properties import example_lines, examples
from tests.support.readers import READERS, BrokenPromiseError, Reader, outcome, prepare

CORPUS = Path(__file__).parent / "corpus"
NAMES = [reader.name for reader in READERS]


@pytest.mark.parametrize("reader", READERS, ids=NAMES)
def test_the_good_file_is_valid(reader: Reader, tmp_path: Path) -> None:
    prepare(reader, tmp_path)
    assert outcome(reader, tmp_path, reader.good()) == "valid"


@settings(
    max_examples=examples(30),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much],
)
@given(st.data())
@pytest.mark.parametrize("reader", READERS, ids=NAMES)
def test_damaged_files(reader: Reader, data: st.DataObject) -> None:
    with tempfile.TemporaryDirectory() as folder:
        prepare(reader, Path(folder))
        assert outcome(reader, Path(folder), data.draw(damaged(reader))) in ("valid", "refused")


@pytest.mark.parametrize("found", sorted(CORPUS.glob("*/*")), ids=lambda path: f"{path.parent.name}/{path.name}")
def test_recorded_failures(found: Path, tmp_path: Path) -> None:
    """Readers handle every case that ``make fuzz`` recorded as a failure."""
    (reader,) = [reader for reader in READERS if reader.name.replace(" ", "_") == found.parent.name]
    prepare(reader, tmp_path)
    assert outcome(reader, tmp_path, found.read_bytes()) in ("valid", "refused")


def test_slow_means_slow_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A pause of the machine does not count as a failure, but a slow reader does."""
    monkeypatch.setattr(readers, "MAX_SECONDS", 0.1)
    times: list[float] = []

    def read(path: Path) -> None:
        end = time.process_time() + times.pop()
        while time.process_time() < end:
            pass

    slow = Reader("slow", "a", lambda: b"", read)
    times[:] = [0.0, 0.3]
    assert outcome(slow, tmp_path, b"") == "valid" and times == []
    times[:] = [0.3, 0.3]
    with pytest.raises(BrokenPromiseError, match=r"^slow: 0\.3 s of work in .*; 0\.3 s of work in .* the first time$"):
        outcome(slow, tmp_path, b"")


def test_a_failing_example_is_printed_as_a_decorator() -> None:
    """Arguments on several lines are joined to one line without comments; examples of ``st.data()`` have no
    decorator."""

    @settings(max_examples=50)
    @given(shape=st.builds(dict, x=st.integers(10**4, 10**5)), note=st.text())
    def law(shape: dict[str, int], note: str) -> None:
        assert shape["x"] < 0

    with pytest.raises(AssertionError) as caught:
        law()
    (line,) = example_lines("\n".join(caught.value.__notes__))
    assert line.startswith("@example(shape=") and "10000" in line and line.endswith(", note='')")
    assert example_lines("E   Failing test case: law(\nE       data=data(...),\nE   )\n") == []
