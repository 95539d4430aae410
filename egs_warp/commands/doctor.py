"""``egs-warp doctor``: report devices, versions and missing components, and give advice."""

from __future__ import annotations

import argparse
import sys

from egs_warp.commands.flags import Commands

EXAMPLES = (
    "",
    "--warm",
    "--warm --device cuda:0",
)


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    doctor = commands.add_parser(
        "doctor", help="check this machine: devices, driver, versions, memory, missing components"
    )
    doctor.add_argument("--warm", action="store_true", help="compile all kernels now (half a minute on two cores)")
    doctor.add_argument("--device", default="cpu", help="device that --warm compiles for: cpu (default) or cuda:0")
    doctor.set_defaults(run=_doctor)


def _doctor(args: argparse.Namespace) -> int:
    from tqdm import tqdm

    from egs_warp.launching import use_device
    from egs_warp.pipelines.machine import compile_kernels, inspect_machine

    use_device(args.device)
    if args.warm:
        with tqdm(desc="compile", unit="file", file=sys.stderr) as bar:

            def show_progress(name: str, done: int, total: int) -> None:
                bar.total = total
                bar.set_postfix_str(name, refresh=False)
                bar.update(done - bar.n)
                bar.refresh()

            compile_kernels(args.device, progress=show_progress)
    machine = inspect_machine()
    print("\n".join(machine.lines()))
    for device in machine.devices:
        if device.compiled < device.files:
            print(
                f"to do    {device.files - device.compiled} kernel files are not compiled for {device.alias}; the first"
                f" runs compile them; to compile them now: egs-warp doctor --warm --device {device.alias}"
            )
    return 1 if machine.problems else 0
