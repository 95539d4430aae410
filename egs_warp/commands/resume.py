"""``egs-warp resume``: continue an interrupted run of ``animate``."""

from __future__ import annotations

import argparse
from pathlib import Path

from egs_warp.commands.animate import EXIT_NOT_AS_REQUESTED, run_animate
from egs_warp.commands.config import NAME, changed_capture, with_config
from egs_warp.commands.flags import Commands, named_path
from egs_warp.errors import UserError

EXAMPLES = ("out/jump",)


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``, which already contain ``animate``."""
    resume = commands.add_parser(
        "resume", help="continue an interrupted run of animate, with bitwise identical results"
    )
    resume.add_argument("folder", metavar="run", type=named_path, help="folder that was --out of the run")
    resume.add_argument(
        "--trust",
        action="store_true",
        help="allow a TorchScript file for the run's --inpainter; such a file can run any program",
    )
    resume.set_defaults(run=_resume, animate=commands.choices["animate"])


def _resume(args: argparse.Namespace) -> int:
    from egs_warp.io.run_folder import clean_up, has_finished

    folder: Path = args.folder
    if has_finished(folder):
        from egs_warp.pipelines.finished_run import PARTS

        status = status_of_finished(folder)
        clean_up(folder, PARTS)
        print(f"{folder}: this run has finished")
        return status
    config = folder / NAME
    if not config.is_file():
        raise UserError(f"{config}: is missing; the run was interrupted before its first step; start it again")
    arguments = [f"--config={config}", f"--out={folder}", *(["--trust"] if args.trust else [])]
    run = args.animate.parse_args(with_config(arguments, args.animate))
    run.resume = True
    if changed_capture(str(config), run.capture):
        raise UserError(
            f"{run.capture}: differs from the capture of the run; restore that file, or start the run again"
        )
    return run_animate(run)


def status_of_finished(folder: Path) -> int:
    """Return the exit status of the finished run of ``animate`` in ``folder``."""
    from egs_warp.io.text import parse_json, read_text
    from egs_warp.pipelines.end_state import State

    report = parse_json(read_text(folder / "report.json"), folder / "report.json")
    failures = [state.value for state in State if state.is_failure]
    return EXIT_NOT_AS_REQUESTED if isinstance(report, dict) and report.get("state") in failures else 0
