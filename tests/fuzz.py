"""``make fuzz MINUTES=10``: many damaged files for every reader; ``python -m tests.fuzz --help``.

The strategies of ``tests/support/damage.py`` are driven by Atheris (coverage of the package) where it is installed,
else by random bytes. A case that breaks a promise is kept in ``tests/corpus/READER/``, where the tests find it.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import resource
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

CORPUS = Path(__file__).parent / "corpus"
_MEMORY = 256
"""MiB that the readers of a process may take beyond what it began with: its inputs hold some kilobytes."""
_LARGEST_BUFFER = 4096
"""Bytes from which Hypothesis draws one input."""
_COLUMNS = ("reader", "inputs", "valid", "refused", "broken", "mib", "by")
_SEED = 20_261_122


def main() -> int:
    """Give each reader its share of the time; returns 1 where any promise was broken."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0, help="for all readers together")
    parser.add_argument("--inputs", type=int, default=0, help="end a reader after so many, however long (0: never)")
    parser.add_argument("--reader", action="append", help="only this one; may be repeated")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.child:
        _fuzz(chosen.child, 60.0 * chosen.minutes, chosen.inputs)
        return 0
    from tests.support.readers import READERS

    names = chosen.reader or [reader.name for reader in READERS]
    share = chosen.minutes / len(names)
    print("| reader | inputs | valid | refused | broken | peak MiB | driven by |\n|---|---|---|---|---|---|---|")
    total, broken = 0, 0
    for name in names:
        command = [sys.executable, "-m", "tests.fuzz", "--child", name, "--minutes", str(share)]
        done = subprocess.run([*command, "--inputs", str(chosen.inputs)], capture_output=True, text=True)
        lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
        if not lines:
            print(f"| {name} | the process died: {done.stderr[-400:]!r} |", flush=True)
            broken += 1
            continue
        found = json.loads(lines[-1])
        total, broken = total + found["inputs"], broken + found["broken"]
        print("| " + " | ".join(str(found[key]) for key in _COLUMNS), "|", flush=True)
    print(f"{total} inputs, {broken} broken promises")
    return int(broken > 0)


def _fuzz(name: str, seconds: float, inputs: int) -> None:
    """Drive one reader and print what came out as a line of JSON."""
    atheris: Any = None
    if find_spec("atheris") is not None:
        import atheris

        with atheris.instrument_imports(include=["egs_warp.io", "egs_warp.motions", "egs_warp.muscles"]):
            from tests.support import damage, readers
    else:
        from tests.support import damage, readers
    import warp as wp
    from hypothesis import HealthCheck, Phase, given, settings

    wp.config.log_level = wp.LOG_ERROR
    reader = next(reader for reader in readers.READERS if reader.name == name)
    counts = {"inputs": 0, "valid": 0, "refused": 0, "broken": 0}
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
        @given(damage.damaged(reader))
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
                _keep(name, data)
                print(error, file=sys.stderr)

        def end() -> None:
            by = "Atheris" if atheris is not None else "random bytes"
            print(json.dumps({"reader": name, **counts, "mib": _peak() - base, "by": by}), flush=True)
            # libFuzzer does not come back.
            os._exit(0)

        def drive(buffer: bytes) -> None:
            if time.monotonic() - began > seconds or 0 < inputs <= counts["inputs"]:
                end()
            one.hypothesis.fuzz_one_input(buffer)  # pyright: ignore[reportFunctionMemberAccess]

        if atheris is not None:
            options = [sys.argv[0], f"-max_len={_LARGEST_BUFFER}", f"-seed={_SEED}", "-verbosity=0", "-rss_limit_mb=0"]
            options.append(f"-artifact_prefix={place}/")
            atheris.Setup(options, drive)
            atheris.Fuzz()
        generator = random.Random(_SEED)
        while True:
            drive(generator.randbytes(generator.randint(0, _LARGEST_BUFFER)))


def _keep(name: str, data: bytes) -> None:
    folder = CORPUS / name.replace(" ", "_")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / hashlib.sha256(data).hexdigest()[:12]).write_bytes(data)


def _peak() -> int:
    """MiB that this process has held at most."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024


if __name__ == "__main__":
    sys.exit(main())
