"""Three ways through the house, walked and counted: a capture to a pixel, a scene to its filled floor, an activation to
a force.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import numpy as np
import pytest

import egs_warp as egs
from egs_warp.cli import main
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io.capture import Capture
from egs_warp.io.raw import RawCapture

PACKAGE = Path(egs.__file__).parent
CARRIERS = (RawCapture, Capture, GaussianCloud, egs.PreparedScene)
"""What a capture is while it is on its way."""


def rooms_entered(way: Callable[[], object]) -> set[str]:
    """Rooms of which a function is given Gaussians, or gives some, while ``way`` is walked; kernels are counted with
    the room that launches them."""
    found: set[str] = set()
    start = str(PACKAGE) + "/"

    def watch(frame: FrameType, event: str, returned: object) -> None:
        file = frame.f_code.co_filename
        if event not in ("call", "return") or not file.startswith(start):
            return
        parts = file[len(start) :].split("/")
        if len(parts) == 1 or parts[0] in found:
            return
        if any(isinstance(value, CARRIERS) for value in (returned, *frame.f_locals.values())):
            found.add(parts[0])

    before = sys.getprofile()
    sys.setprofile(watch)
    try:
        way()
    finally:
        sys.setprofile(before)
    return found


@pytest.mark.slow
def test_a_capture_enters_at_most_fourteen_rooms_on_its_way_to_a_pixel(tmp_path: Path) -> None:
    """From the command's line to the film; thirty-four when the package lay flat."""
    made = egs.scene("pawn", device="cpu")
    egs.write_ply(tmp_path / "pawn.ply", made.object)
    line = ["animate", str(tmp_path / "pawn.ply"), "--up", "z", "--frames", "2", "--size", "32"]
    rooms = rooms_entered(lambda: main([*line, "--out", str(tmp_path / "run")]))
    assert {"commands", "io", "pipelines", "meshing", "deformation", "render"} <= rooms
    assert len(rooms) <= 14, sorted(rooms)


@pytest.mark.slow
def test_a_scene_enters_at_most_eight_rooms_on_its_way_to_a_filled_floor(tmp_path: Path) -> None:
    """From the file to the background without its object; fourteen when the package lay flat."""
    whole = egs.scene("pawn", device="cpu").whole()[0]
    near = np.linalg.norm(whole.means.numpy()[:, :2], axis=1) < 1.2
    egs.write_ply(tmp_path / "scene.ply", whole.subset(near))

    def way() -> None:
        scene = egs.read_capture(tmp_path / "scene.ply").cloud
        prepared = egs.prepare_scene(scene, egs.ObjectSpec(point=np.array([0.0, 0.0, 0.5])))
        assert prepared.filled is not None

    rooms = rooms_entered(way)
    assert {"io", "segmentation", "inpainting"} <= rooms
    assert len(rooms) <= 8, sorted(rooms)


def test_an_activation_becomes_a_force_in_one_module() -> None:
    """Where the lines of segments are read off the nodes: columns and forces are made of them in the same place, and
    nowhere else but for many worlds, which tests hold to what each does alone (the ledger, which shares no code with
    the solver, reads the file of a run)."""
    readers = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Attribute) and node.attr == "difference_rows":
                readers.add(path.relative_to(PACKAGE).as_posix())
    # The set itself knows lengths.
    assert readers == {"muscles/muscle_set.py", "muscles/tension.py", "fem/batch_elasticity.py"}
