"""Fuzz test of every reader with many corrupted files (``make fuzz MINUTES=10``, ``python -m tests.fuzz --help``).

The strategies of ``tests/support/corruption.py`` are driven by Atheris (coverage of the package) if it is installed,
otherwise by random bytes. A case that fails is written to ``tests/corpus/READER/``, where the tests find it.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import random
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from tests.support.memory import peak_bytes

CORPUS = Path(__file__).parent / "corpus"
_MEMORY = 256
"""Maximum growth in MiB of the memory of a process that reads inputs of a few kilobytes."""
_MAX_BUFFER = 4096
"""Maximum number of random bytes from which Hypothesis generates one input."""
_COUNTS: tuple[str, ...] = ("inputs", "valid", "refused", "broken")
_PIECE = 20_000
"""Maximum number of inputs per process if ``--inputs`` is given."""
_MAX_REASONS = 50
"""Maximum number of failures that are recorded for one reader."""
_SEED = 20_261_122


def main() -> int:
    """Run each reader for its share of the time; return 1 if any reader failed, else 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0, help="total time of all readers (default %(default)s)")
    parser.add_argument("--inputs", type=int, default=0, help="maximum number of inputs per reader (0: no limit)")
    parser.add_argument("--reader", action="append", help="only this reader; may be repeated")
    parser.add_argument("--processes", type=int, default=1, help="parallel processes (default %(default)s)")
    parser.add_argument("--counts", type=Path, help="file of counts, to which those of this run are added")
    parser.add_argument("--child", nargs=2, metavar=("READER", "SEED"), help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.child:
        _fuzz(chosen.child[0], int(chosen.child[1]), 60.0 * chosen.minutes, chosen.inputs)
        return 0
    from tests.support.readers import READERS

    names = chosen.reader or [reader.name for reader in READERS]
    tally = Tally(names, chosen.counts)
    deadline = time.monotonic() + 60.0 * chosen.minutes
    share = 60.0 * chosen.minutes * chosen.processes / len(names)
    # If a number of inputs is given, they are divided into chunks, which the processes take in turn.
    rounds = 1 if chosen.inputs == 0 else math.ceil(chosen.inputs / _PIECE)
    with ThreadPoolExecutor(chosen.processes) as pool:
        for _ in range(rounds):
            for name in names:
                pool.submit(_piece, name, tally, deadline, share, chosen.inputs)
    return tally.report()


class Tally:
    """Counts of the inputs and outcomes of each reader, which are stored in a file if a path is given."""

    def __init__(self, names: list[str], path: Path | None) -> None:
        self._path, self._lock = path, threading.Lock()
        self.counts: dict[str, dict[str, Any]] = {
            name: dict.fromkeys(_COUNTS, 0) | {"mib": 0, "by": "", "why": []} for name in names
        }
        self.died: list[str] = []
        self._started = dict.fromkeys(names, 0)
        if path is not None and path.is_file():
            self.counts |= json.loads(path.read_text())

    def seed(self, name: str) -> int:
        """Return the seed of the next chunk, which differs from all earlier ones, also those of earlier runs."""
        with self._lock:
            self._started[name] += 1
            return _SEED + self.counts[name]["inputs"] + 1_000_003 * self._started[name]

    def add(self, name: str, found: dict[str, Any]) -> None:
        with self._lock:
            known = self.counts[name]
            self.counts[name] = {key: known[key] + found[key] for key in _COUNTS}
            self.counts[name] |= {"mib": max(known["mib"], found["mib"]), "by": found["by"]}
            self.counts[name]["why"] = [*known.get("why", []), *found["why"]][:_MAX_REASONS]
            if self._path is not None:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                self._path.write_text(json.dumps(self.counts, indent=1) + "\n")

    def report(self) -> int:
        """Print a table of the counts; return 1 if any reader failed, else 0."""
        print("| reader | inputs | valid | refused | broken | peak MiB | driven by |\n|---|---|---|---|---|---|---|")
        for name, found in self.counts.items():
            print(f"| {name} |", " | ".join(str(found[key]) for key in (*_COUNTS, "mib", "by")), "|")
        for line in (*(why for found in self.counts.values() for why in found.get("why", [])), *self.died):
            print(line)
        total, broken = (sum(found[key] for found in self.counts.values()) for key in ("inputs", "broken"))
        print(f"{total} inputs, {broken + len(self.died)} broken promises")
        return int(broken + len(self.died) > 0)


def _piece(name: str, tally: Tally, deadline: float, share: float, inputs: int) -> None:
    """Run one reader in a process until its share of the time, or its number of inputs, is used."""
    seconds = min(deadline - time.monotonic(), share if inputs == 0 else math.inf)
    lacking = min(inputs - tally.counts[name]["inputs"], _PIECE)
    if seconds < 1.0 or (inputs and lacking <= 0):
        return
    command = [sys.executable, "-m", "tests.fuzz", "--child", name, str(tally.seed(name))]
    command += ["--minutes", str(seconds / 60.0), "--inputs", str(lacking if inputs else 0)]
    done = subprocess.run(command, capture_output=True, text=True)
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    if lines:
        tally.add(name, json.loads(lines[-1]))
    else:
        tally.died.append(f"{name}: the process died: {done.stderr[-400:]!r}")


def _fuzz(name: str, seed: int, seconds: float, inputs: int) -> None:
    """Run one reader on random inputs, print the counts as a line of JSON and end the process."""
    atheris: Any = None
    if find_spec("atheris") is not None:
        import atheris

        with atheris.instrument_imports(include=["egs_warp.io", "egs_warp.motions", "egs_warp.muscles"]):
            from tests.support import corruption, readers
    else:
        from tests.support import corruption, readers
    import warp as wp
    from hypothesis import HealthCheck, Phase, given, settings

    wp.config.log_level = wp.LOG_ERROR
    reader = next(reader for reader in readers.READERS if reader.name == name)
    counts: dict[str, int] = dict.fromkeys(_COUNTS, 0)
    why: list[str] = []
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        readers.prepare(reader, folder)
        readers.outcome(reader, folder, reader.good())
        began, base = time.monotonic(), _peak()
        peak = base

        @settings(
            database=None,
            deadline=None,
            phases=[Phase.generate],
            suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much],
        )
        @given(corruption.damaged(reader))
        def one(data: bytes) -> None:
            nonlocal peak
            counts["inputs"] += 1
            try:
                counts[readers.outcome(reader, folder, data)] += 1
                if _peak() > max(peak, base + _MEMORY):
                    peak = _peak()
                    raise readers.BrokenPromiseError(f"{name}: {peak - base} MiB")
            except readers.BrokenPromiseError as error:
                counts["broken"] += 1
                why.append(f"{_keep(name, data)}: {error}"[:400])

        def end() -> None:
            by = "Atheris" if atheris is not None else "random bytes"
            print(json.dumps({"reader": name, **counts, "mib": _peak() - base, "by": by, "why": why}), flush=True)
            # libFuzzer does not return, so the process ends here.
            os._exit(0)

        def drive(buffer: bytes) -> None:
            if time.monotonic() - began > seconds or 0 < inputs <= counts["inputs"]:
                end()
            one.hypothesis.fuzz_one_input(buffer)  # pyright: ignore[reportFunctionMemberAccess]

        if atheris is not None:
            options = [sys.argv[0], f"-max_len={_MAX_BUFFER}", f"-seed={seed}", "-verbosity=0", "-rss_limit_mb=0"]
            options.append(f"-artifact_prefix={place}/")
            atheris.Setup(options, drive)
            atheris.Fuzz()
        generator = random.Random(seed)
        while True:
            drive(generator.randbytes(generator.randint(0, _MAX_BUFFER)))


def _keep(name: str, data: bytes) -> str:
    """Write a failing input into the corpus, where the tests find it; return its name."""
    folder = CORPUS / name.replace(" ", "_")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / hashlib.sha256(data).hexdigest()[:12]
    path.write_bytes(data)
    return f"{folder.name}/{path.name}"


def _peak() -> int:
    """Return the peak memory of this process, MiB."""
    return peak_bytes() // 2**20


if __name__ == "__main__":
    sys.exit(main())
