"""Write the built-in objects as captures to try the commands on, each one alone and in its scene."""

from __future__ import annotations

import argparse
from pathlib import Path

import egs_warp as egs


def main(arguments: list[str] | None = None) -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/captures"))
    folder = egs.writable_folder(parser.parse_args(arguments).out)
    for name in egs.BUILT_IN_SCENES:
        made = egs.scene(name)
        egs.write_ply(folder / f"{name}.ply", made.object)
        egs.write_ply(folder / f"{name}_in_room.ply", made.whole()[0])
    names = ", ".join(egs.BUILT_IN_SCENES)
    print(f"wrote {names} as NAME.ply and NAME_in_room.ply to {folder}; z is up, and a standing object is 1 unit tall")


if __name__ == "__main__":
    with egs.one_line_errors("captures.py"):
        main()
