"""A pawn and a box of one captured scene become a creature and a prop, and the pawn jumps against the box.

The capture is a chess board on which both stand. They are cut out of it, and the board is filled below them. Writes the
film, the contact sheet, the report, pictures of the cut, and a trajectory and a report for each body.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import egs_warp as egs

BOX_SIZE = 0.3, 0.5, 0.8
"""Length, width and height of the box, in heights of the pawn."""
BOX_AT = 1.4
"""Position of the middle of the box on the x axis, in heights of the pawn, which stands at the origin."""
WORLD = """\
scene: {scene}
up: z
bodies:
  - name: pawn
    object: 0,0,0.5
    nodes: {nodes}
    motion: jump to box
  - name: box
    object: {box},0,0.4
    prop: true
    density: 100
"""


def main(arguments: list[str] | None = None) -> egs.WorldReport:
    """Run the example and return the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/board"))
    parser.add_argument("--nodes", type=int, default=100, help="approximate number of cage nodes of the pawn")
    parser.add_argument("--frames", type=int, help="number of frames (default: until all bodies are at rest)")
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--device", default="cpu")
    chosen = parser.parse_args(arguments)
    egs.use_device(chosen.device)
    folder = egs.writable_folder(chosen.out.with_name(f"{chosen.out.name}_capture"))
    egs.write_ply(folder / "board.ply", capture())
    path = folder / "world.yaml"
    path.write_text(WORLD.format(scene="board.ply", nodes=chosen.nodes, box=BOX_AT))
    script = egs.read_world(path, device=chosen.device)
    run = egs.simulate(script.world, script.motions, frames=chosen.frames)
    report = egs.write_world(run, chosen.out, size=chosen.size, view_from=(0.5, -1.0, 0.5), overwrite=True)
    print(report.summary())
    print(f"wrote {report.film}, sheet.png, report.json and a folder for each body to {chosen.out}")
    return report


def capture() -> egs.GaussianCloud:
    """Return the capture of the pawn and the box on the chess board."""
    board, _ = egs.scene("pawn").whole()
    box = egs.box_cloud(BOX_SIZE, lambda points: (0.2, 0.35, 0.55))
    colours = np.zeros((box.count, *board.sh.shape[1:], 3))
    colours[:, :1] = box.sh.numpy()
    placed = egs.GaussianCloud.from_numpy(
        box.means.numpy() + np.array([BOX_AT, 0.0, 0.0]),
        box.rotations.numpy(),
        box.log_scales.numpy(),
        box.opacity_logits.numpy(),
        colours,
    )
    return egs.concatenate(board, placed)


if __name__ == "__main__":
    with egs.one_line_errors("board.py"):
        main()
