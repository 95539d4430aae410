"""Mutation testing: the fast tests of a package must detect small changes to its code, one at a time (``make
mutation``).

``python -m tests.mutation --help`` lists the options. Each process has its own copy of the package and of the tests,
and its own kernel cache. Results are appended to a session file at once, so that an interrupted run can be continued; a
result is valid while the changed file is unchanged. Surviving mutants that reveal no gap in the tests are listed with
reasons in ``tests/support/surviving_mutants/``. Nothing is downloaded; only cosmic-ray's operators and pytest are
needed.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tests.support.mutants import PACKAGES, ROOT, Mutant, sample, tests_of
from tests.support.surviving_mutants import reason_for

OUT = Path("out/mutation")
_SEED = 20_261_123
_FAST = "not (slow or data or example or cuda)"
_MIN_KILLED = 0.8
"""Minimum fraction of a package's mutants that tests must kill, not counting survivors that reveal no gap in the
tests."""
_TIME_FACTOR = 4.0
"""Time limit as a multiple of the duration of the package's tests; a mutant that takes longer counts as killed."""
_HEAD_START = 60.0
"""Additional time for the compilation of changed kernels, s."""
_KINDS = ("assertion", "exception", "time", "survived")


@dataclass(frozen=True)
class Outcome:
    """Result of one mutant."""

    kind: str
    """Kind of failure (``assertion``, ``exception`` or ``time`` limit), or ``survived``."""
    seconds: float
    test: str
    """Name of the test that failed."""


class Session:
    """Results of finished mutants, one line of JSON each, and durations of the tests of unchanged packages."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self.results: dict[str, dict[str, Any]] = {}
        self.baselines: dict[str, float] = {}
        if path.is_file():
            for line in path.read_text().splitlines():
                self._take(json.loads(line))
        path.parent.mkdir(parents=True, exist_ok=True)

    def add(self, entry: dict[str, Any]) -> None:
        with self._lock:
            self._take(entry)
            with self._path.open("a") as file:
                file.write(json.dumps(entry) + "\n")

    def _take(self, entry: dict[str, Any]) -> None:
        if "baseline" in entry:
            self.baselines[entry["baseline"]] = entry["seconds"]
        else:
            self.results[entry["key"]] = entry


class Copy:
    """Copy of the tree in which one process makes changes."""

    def __init__(self, folder: Path, kernels: Path) -> None:
        self.folder = folder
        self._kernels = folder / "kernels"
        for name in ("egs_warp", "tests", "benchmarks/contact_states"):
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("client", "corpus", "*.pyc"))
        for name in ("pyproject.toml", "README.md", "docs", "examples"):
            copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
            copy(ROOT / name, folder / name)
        if kernels.is_dir():
            shutil.copytree(kernels, self._kernels)

    def run(self, tests: Sequence[str], limit: float) -> Outcome:
        """Run the tests in the copy until one fails."""
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-m", _FAST, "--tb=native", "--durations=0"]
        command += ["-p", "no:cacheprovider", "-p", "no:randomly", *tests]
        began = time.monotonic()
        with tempfile.TemporaryFile("w+", errors="replace") as output:
            process = subprocess.Popen(
                command,
                cwd=self.folder,
                env=self._environment(),
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            try:
                status = process.wait(limit)
            except subprocess.TimeoutExpired:
                return Outcome("time", time.monotonic() - began, "")
            finally:
                _end(process)
            output.seek(0)
            text = output.read()
        seconds = time.monotonic() - began
        if status == 0:
            return Outcome("survived", seconds, "")
        failed = [line for line in text.splitlines() if line.startswith(("FAILED ", "ERROR "))]
        if status == 5 or "unrecognized arguments" in text:
            raise RuntimeError(f"no test ran: {text[-600:]}")
        kind = "assertion" if "AssertionError" in text else "exception"
        return Outcome(kind, seconds, failed[0].split()[1] if failed else f"exit status {status}: {text[-300:]}")

    def try_mutant(self, mutant: Mutant, limit: float) -> Outcome:
        place = self.folder / mutant.file
        try:
            place.write_text(mutant.text())
            return self.run(tests_of(mutant.package, mutant.file), limit)
        finally:
            shutil.copy2(ROOT / mutant.file, place)

    def keep_kernels(self, kernels: Path) -> None:
        """Copy the kernels that were compiled in this copy of the tree to the folder ``kernels``, for other copies."""
        shutil.copytree(self._kernels, kernels, dirs_exist_ok=True)

    def _environment(self) -> dict[str, str]:
        paths = [str(self.folder), *filter(None, [os.environ.get("PYTHONPATH")])]
        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
        own = {"PYTHONPATH": os.pathsep.join(paths), "WARP_CACHE_PATH": str(self._kernels)}
        # No bytecode is written, because it would be stale after a change of the same length, and no GPU is used.
        return os.environ | threads | own | {"PYTHONDONTWRITEBYTECODE": "1", "CUDA_VISIBLE_DEVICES": ""}


def main() -> int:
    """Run the mutation tests; return 1 if too few mutants are killed, or if the tests fail on the unchanged code."""
    chosen = _arguments()
    began = time.monotonic()
    session = Session(chosen.session)
    with tempfile.TemporaryDirectory(prefix="mutation-") as place:
        if not _baselines(chosen, session, Path(place)):
            return 1
        mutants = _samples(chosen)
        open_ones = [mutant for mutant in mutants if _is_open(mutant, session, chosen.again)]
        print(f"{len(mutants)} mutants, {len(open_ones)} to try", flush=True)
        _try_all(open_ones, chosen, session, Path(place), began + 60.0 * chosen.minutes)
    return _report(mutants, session, chosen.json)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--packages", default=",".join(PACKAGES), help="comma-separated (default all)")
    parser.add_argument("--count", type=int, default=200, help="mutants per package (default %(default)s)")
    parser.add_argument("--seed", type=int, default=_SEED, help="seed of the sample (default %(default)s)")
    parser.add_argument(
        "--processes", type=int, default=1, help="parallel processes, each with its own copy (default %(default)s)"
    )
    parser.add_argument("--minutes", type=float, default=1e6, help="time limit; running mutants are stopped")
    parser.add_argument("--session", type=Path, default=OUT / "session.jsonl", help="(%(default)s)")
    parser.add_argument("--json", type=Path, default=OUT / "survivors.json", help="survivors (%(default)s)")
    parser.add_argument("--again", action="store_true", help="repeat mutants that survived")
    chosen = parser.parse_args()
    chosen.packages = chosen.packages.split(",")
    unknown = sorted(set(chosen.packages) - set(PACKAGES))
    if unknown:
        parser.error(f"no such package: {', '.join(unknown)}; give some of {', '.join(PACKAGES)}")
    return chosen


def _samples(chosen: argparse.Namespace) -> list[Mutant]:
    """Return the mutants of all packages in turn, so that an interrupted run covers each package."""
    with ProcessPoolExecutor(min(chosen.processes, len(chosen.packages))) as pool:
        count = len(chosen.packages)
        samples = list(pool.map(sample, chosen.packages, [chosen.count] * count, [chosen.seed] * count))
    longest = max(map(len, samples))
    return [mutants[i] for i in range(longest) for mutants in samples if i < len(mutants)]


def _is_open(mutant: Mutant, session: Session, repeat_survivors: bool) -> bool:
    known = session.results.get(mutant.key)
    return known is None or (repeat_survivors and known["kind"] == "survived" and reason_for(mutant) is None)


def _baselines(chosen: argparse.Namespace, session: Session, place: Path) -> bool:
    """Run the tests of each package on the unchanged code, and record their duration and kernels. Return False if a
    test fails."""
    state = _digest(ROOT.joinpath(name) for name in ("egs_warp", "tests"))
    kernels = OUT / "kernels"
    packages = [
        package for package in chosen.packages if f"{package}:{state}" not in session.baselines or not kernels.is_dir()
    ]

    def one(package: str) -> tuple[str, Outcome]:
        copy = Copy(place / f"right-{package}", kernels)
        outcome = copy.run(tests_of(package, ""), 1800.0)
        copy.keep_kernels(place / "kernels" / package)
        return package, outcome

    with ThreadPoolExecutor(chosen.processes) as pool:
        outcomes = list(pool.map(one, packages))
    for package, outcome in outcomes:
        if outcome.kind != "survived":
            print(f"{package}: a test fails on the unchanged code: {outcome.test or outcome.kind}")
            return False
        shutil.copytree(place / "kernels" / package, kernels, dirs_exist_ok=True)
        session.add({"baseline": f"{package}:{state}", "seconds": round(outcome.seconds, 1)})
    for package in chosen.packages:
        session.baselines[package] = session.baselines[f"{package}:{state}"]
        print(f"{package}: its tests take {session.baselines[package]:.0f} s", flush=True)
    return True


def _try_all(
    mutants: Iterable[Mutant], chosen: argparse.Namespace, session: Session, place: Path, deadline: float
) -> None:
    copies: queue.SimpleQueue[Copy] = queue.SimpleQueue()

    def one(mutant: Mutant) -> None:
        try:
            copy = copies.get_nowait()
        except queue.Empty:
            copy = Copy(Path(tempfile.mkdtemp(dir=place)) / "tree", OUT / "kernels")
        try:
            limit = _HEAD_START + _TIME_FACTOR * session.baselines[mutant.package]
            left = deadline - time.monotonic()
            if left <= 0.0 or mutant.is_stale:
                return
            outcome = copy.try_mutant(mutant, min(limit, left))
            if outcome.kind == "time" and left < limit:
                return
        finally:
            copies.put(copy)
        entry = {"key": mutant.key, **asdict(mutant), "kind": outcome.kind, "seconds": round(outcome.seconds, 1)}
        session.add(entry | {"test": outcome.test})
        if outcome.kind == "survived" and reason_for(mutant) is None:
            print(f"survived: {mutant.file}:{mutant.line}\n  - {mutant.before}\n  + {mutant.after}", flush=True)

    with ThreadPoolExecutor(chosen.processes) as pool:
        for done in as_completed([pool.submit(one, mutant) for mutant in mutants]):
            done.result()


def _report(mutants: list[Mutant], session: Session, path: Path) -> int:
    """Print a table of the packages, and write the survivors to a file."""
    print("| package | tried | by assertion | by exception | by time | survived | no gap | killed | s per mutant |")
    print("|---|---|---|---|---|---|---|---|---|")
    survivors, short = [], False
    for package in dict.fromkeys(mutant.package for mutant in mutants):
        known = [mutant for mutant in mutants if mutant.package == package and mutant.key in session.results]
        if not known:
            continue
        results = [session.results[mutant.key] for mutant in known]
        count = {kind: sum(result["kind"] == kind for result in results) for kind in _KINDS}
        alive = [m for m, result in zip(known, results, strict=True) if result["kind"] == "survived"]
        survivors += [asdict(mutant) | {"no gap": reason_for(mutant)} for mutant in alive]
        no_gap = sum(reason_for(mutant) is not None for mutant in alive)
        killed = len(known) - len(alive)
        share = killed / max(len(known) - no_gap, 1)
        mean = sum(result["seconds"] for result in results) / len(results)
        short |= share < _MIN_KILLED
        cells = (package, len(known), *count.values(), no_gap, f"{100 * share:.0f} %", f"{mean:.1f}")
        print("| " + " | ".join(map(str, cells)) + " |")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(survivors, indent=1) + "\n")
    print(f"survivors: {path}")
    return int(short)


def _digest(folders: Iterable[Path]) -> str:
    state = hashlib.sha256()
    for path in sorted(path for folder in folders for path in folder.rglob("*.py")):
        state.update(path.relative_to(ROOT).as_posix().encode() + path.read_bytes())
    return state.hexdigest()[:12]


def _end(process: subprocess.Popen[bytes]) -> None:
    """Kill the process and its children."""
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except ProcessLookupError:
        pass
    process.wait()
