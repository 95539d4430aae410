"""The built-in objects and rooms as captures on disk, to try every command on: each object alone, and in its room."""

from __future__ import annotations

import argparse
from pathlib import Path

import warp as wp

from egs_warp.assets import BUILT_IN_SCENES, scene
from egs_warp.errors import one_line_errors
from egs_warp.io import writable_folder, write_ply


def main(arguments: list[str] | None = None) -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/captures"))
    wp.config.log_level = wp.LOG_WARNING
    folder = writable_folder(parser.parse_args(arguments).out)
    for name in BUILT_IN_SCENES:
        made = scene(name)
        write_ply(folder / f"{name}.ply", made.object)
        write_ply(folder / f"{name}_in_room.ply", made.whole()[0])
    print(
        f"wrote {', '.join(BUILT_IN_SCENES)} as NAME.ply and NAME_in_room.ply into {folder}; z is up, 1 is their height"
    )


if __name__ == "__main__":
    with one_line_errors("captures.py"):
        main()
