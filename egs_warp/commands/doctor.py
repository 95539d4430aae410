"""``egs-warp doctor``: what this machine offers, what is missing, and what to do."""

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
    doctor = commands.add_parser("doctor", help="look at this machine: device, driver, versions, memory, what to do")
    doctor.add_argument("--warm", action="store_true", help="compile all kernels now, half a minute on two cores")
    doctor.add_argument("--device", default="cpu", help="to compile for: cpu (default) or cuda:0")
    doctor.set_defaults(run=_doctor)


def _doctor(chosen: argparse.Namespace) -> int:
    from tqdm import tqdm

    from egs_warp.launching import use_device
    from egs_warp.pipelines.machine import compile_kernels, inspect_machine

    use_device(chosen.device)
    if chosen.warm:
        with tqdm(desc="compile", unit="file", file=sys.stderr) as bar:

            def told(name: str, done: int, of: int) -> None:
                bar.total = of
                bar.set_postfix_str(name, refresh=False)
                bar.update(done - bar.n)
                bar.refresh()

            compile_kernels(chosen.device, progress=told)
    found = inspect_machine()
    print("\n".join(found.lines()))
    for device in found.devices:
        if device.compiled < device.files:
            print(
                f"to do    {device.files - device.compiled} files of kernels wait to be compiled for {device.alias}, in"
                f" the first runs or now: egs-warp doctor --warm --device {device.alias}"
            )
    return 1 if found.problems else 0
