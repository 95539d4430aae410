"""Reproduce every table and figure of the paper from scratch: `make paper`.

The scripts of the tables and figures run in sequence; the current script, the number of scripts and the time that each
one took are printed. ``--out`` (``out/paper``) receives the output (``.txt``), the numbers (``.json``) and the image
(``.png``) of each script, the films of the figures that show motions, and ``paper.md``, which lists all aims, with a
reason for each one that cannot be measured on this device. ``--keep`` skips stages whose JSON exists, so that an
interrupted run can be continued.

The aims are the aims of the scripts, with names such as ``table1.split_helps``; the rows give the exit status of each
script.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from harness import Row, flags, record, timed

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Stage:
    """Stage of the reproduction: a script with its arguments."""

    name: str
    what: str
    script: str
    """Path in the repository."""
    arguments: tuple[str, ...] = ()
    """Command-line arguments; OUT is replaced by the output folder."""
    quick: tuple[str, ...] = ("--quick",)
    device: str | None = None
    """Device on which the script always runs; None for the device of ``--device``."""
    judges: bool = True
    """True if the script takes the common flags of the benchmarks and writes JSON."""


def animated(name: str, figure: int) -> Stage:
    """Return the stage of a figure that shows a motion, run by an example."""
    arguments = ("--out", f"OUT/figure{figure}_{name}")
    return Stage(
        f"figure{figure}",
        f"Figure {figure}: {name}",
        f"examples/{name}.py",
        arguments,
        ("--frames", "24"),
        judges=False,
    )


CAPTURES = ("--clouds", "OUT/captures")
STAGES = (
    Stage("settings", "Table 1: settings, on other objects", "benchmarks/table1.py", ("--choose", *CAPTURES)),
    Stage(
        "table1",
        "Table 1: methods of deforming Gaussians",
        "benchmarks/table1.py",
        ("--chosen", "OUT/settings.json", *CAPTURES),
    ),
    Stage("table2", "Table 2: contact states", "benchmarks/table2.py", device="cpu"),
    Stage("table3", "Table 3 and Figure 9: an object cut at its plane", "benchmarks/table3.py"),
    Stage("figure7", "Figure 7: an object segmented from its scene", "benchmarks/figure7.py"),
    Stage("figure8", "Figure 8: spikes of a twisted bar", "benchmarks/figure8.py"),
    Stage("inpaint", "section 3.7 and Figure 6: the inpainted floor", "benchmarks/inpaint.py"),
    Stage("supplement", "Supplement: the examples in numbers", "benchmarks/examples.py", device="cpu"),
    animated("jump", 1),
    animated("walk", 4),
    animated("twist", 5),
)


def command(stage: Stage, options: argparse.Namespace) -> list[str]:
    """Return the command line that runs a stage."""
    arguments = [one.replace("OUT", str(options.out)) for one in stage.arguments]
    if options.quick:
        arguments += stage.quick
    arguments += ["--device", stage.device or options.device]
    if stage.judges:
        arguments += ["--seed", str(options.seed), "--json", str(options.out / f"{stage.name}.json")]
        arguments += ["--plot", str(options.out / f"{stage.name}.png")]
    return [sys.executable, str(ROOT / stage.script), *arguments]


def run_stage(stage: Stage, options: argparse.Namespace) -> Row:
    """Run a stage and return its row."""
    log = options.out / f"{stage.name}.txt"
    with log.open("w") as file:
        ended, milliseconds = timed(
            subprocess.run, command(stage, options), cwd=ROOT, stdout=file, stderr=subprocess.STDOUT, check=False
        )
    if ended.returncode:
        last = log.read_text().strip().splitlines()[-1:] or ["it printed nothing"]
        print(f"  failed: {last[0]} ({log})", flush=True)
    return {"stage": stage.name, "what": stage.what, "status": ended.returncode, "seconds": 1e-3 * milliseconds}


def collect_aims(
    stages: Sequence[Stage], rows: Sequence[Row], folder: Path
) -> tuple[dict[str, bool | None], dict[str, str]]:
    """Return the aims of all stages as ``stage.aim``, and a reason for each that is None."""
    aims: dict[str, bool | None] = {}
    why: dict[str, str] = {}
    failed = {row["stage"] for row in rows if row["status"]}
    for stage in stages:
        path = folder / f"{stage.name}.json"
        if not stage.judges or stage.name in failed or not path.exists():
            continue
        result = json.loads(path.read_text())
        aims |= {f"{stage.name}.{name}": value for name, value in result["aims"].items()}
        why |= {f"{stage.name}.{name}": reason for name, reason in result["why_null"].items()}
    return aims, why


def summary(rows: Sequence[Row], aims: dict[str, bool | None], why: dict[str, str]) -> str:
    """Return the text of ``paper.md``."""
    word = {True: "met", False: "missed", None: "not judged"}
    lines = ["| table or figure | seconds | files |", "|---|---|---|"]
    for row in rows:
        state = f"{row['seconds']:.0f}" if not row["status"] else f"failed with {row['status']}"
        lines.append(f"| {row['what']} | {state} | `{row['stage']}.*` |")
    lines += ["", "| aim | | why |", "|---|---|---|"]
    lines += [f"| `{name}` | {word[value]} | {why.get(name, '')} |" for name, value in aims.items()]
    return "\n".join(lines) + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run all stages; return the number of stages that failed."""
    parser = flags(
        __doc__,
        quick="--quick of each script, and 24 frames of each motion",
        plot="not used: each stage writes its own image",
    )
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "paper", help="folder for all output")
    parser.add_argument("--only", nargs="+", choices=[stage.name for stage in STAGES], help="only these stages")
    parser.add_argument("--keep", action="store_true", help="skip stages whose JSON exists")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    stages = [stage for stage in STAGES if not options.only or stage.name in options.only]
    rows: list[Row] = []
    for number, stage in enumerate(stages, start=1):
        if options.keep and (options.out / f"{stage.name}.json").exists():
            print(f"[{number}/{len(stages)}] {stage.what}: skipped, its JSON exists", flush=True)
            continue
        print(f"[{number}/{len(stages)}] {stage.what} ...", flush=True)
        rows.append(run_stage(stage, options))
        print(f"[{number}/{len(stages)}] {stage.what}: {rows[-1]['seconds']:.0f} s", flush=True)
    aims, why = collect_aims(stages, rows, options.out)
    text = summary(rows, aims, why)
    (options.out / "paper.md").write_text(text)
    print(f"\n{text}\nwrote {options.out / 'paper.md'}")
    record(options, rows, aims=aims, why_null=why)
    return sum(1 for row in rows if row["status"])


if __name__ == "__main__":
    sys.exit(main())
