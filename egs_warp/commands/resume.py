"""``egs-warp resume``: a run that was cut off goes on."""

from __future__ import annotations

import argparse
from pathlib import Path

from egs_warp.commands.animate import FALLEN, run_animate
from egs_warp.commands.config import NAME, changed_capture, with_config
from egs_warp.commands.flags import Commands, named_path
from egs_warp.errors import UserError

EXAMPLES = ("out/jump",)


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``, of which ``animate`` is one already."""
    resume = commands.add_parser("resume", help="go on with a run of animate that was cut off, to the same bits")
    resume.add_argument("folder", metavar="run", type=named_path, help="the --out of the run")
    resume.add_argument(
        "--trust",
        action="store_true",
        help="let the run's --inpainter be a TorchScript file, which may run any program",
    )
    resume.set_defaults(run=_resume, animate=commands.choices["animate"])


def _resume(chosen: argparse.Namespace) -> int:
    from egs_warp.io.run_folder import clean_up, has_finished
    from egs_warp.io.text import parse_json, read_text
    from egs_warp.pipelines.end_state import State
    from egs_warp.pipelines.finished_run import PARTS

    folder: Path = chosen.folder
    if has_finished(folder):
        report = parse_json(read_text(folder / "report.json"), folder / "report.json")
        clean_up(folder, PARTS)
        print(f"{folder}: this run has finished")
        return (
            FALLEN
            if isinstance(report, dict) and report.get("state") in [state.value for state in State if state.is_failure]
            else 0
        )
    flags = folder / NAME
    if not flags.is_file():
        raise UserError(f"{flags}: is missing, the run was cut off before its first step; begin it again")
    given = [f"--config={flags}", f"--out={folder}", *(["--trust"] if chosen.trust else [])]
    run = chosen.animate.parse_args(with_config(given, chosen.animate))
    run.resume = True
    if changed_capture(str(flags), run.capture):
        raise UserError(f"{run.capture}: is not the file that the run had; bring that back, or begin the run again")
    return run_animate(run)
