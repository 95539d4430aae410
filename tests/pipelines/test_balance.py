"""Check whether the muscles of a file hold the body upright, by a short simulated stand."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from egs_warp.assets import pawn
from egs_warp.cli import main
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.io import write_ply
from egs_warp.motions.fall_monitor import start_overhang
from egs_warp.motions.feet import SupportKind
from egs_warp.motions.script import motion
from egs_warp.notes import Problem
from egs_warp.pipelines import balance
from egs_warp.pipelines.balance import balance_note, unstable_start_notes
from egs_warp.pipelines.creature import Creature, CreatureOptions, initial_stance, make_creature
from egs_warp.pipelines.simulated_run import simulate
from tests.support.creatures import coarse_pawn
from tests.support.meshes import ball_mesh
from tests.support.stances import block_place


def test_a_body_that_falls_over_is_reported_and_one_that_stands_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """There is a note only if the push is too strong for the muscles. The check does not change the run that
    follows."""
    creature = coarse_pawn()
    before = simulate(creature, motion("jump"), frames=3).trajectory
    monkeypatch.setattr(balance, "_STAND_TIME", 0.3)
    assert balance_note(creature) is None
    monkeypatch.setattr(balance, "_STAND_TIME", 4.0)
    monkeypatch.setattr(balance, "_IMPULSE", 6.0)
    note = balance_note(creature)
    assert note is not None
    assert note.startswith(f"muscles: {creature.muscles.segment_count} segments cannot hold it upright: it tilts by ")
    after = simulate(creature, motion("jump"), frames=3).trajectory
    np.testing.assert_array_equal(after.positions, before.positions)


@pytest.mark.parametrize("lean", [0.75, -0.75])
def test_a_weak_fibre_is_reported_if_the_body_must_balance(lean: float, tmp_path: Path) -> None:
    """A leaning pawn with only one fibre, of 0.01 body weights, falls to either side: its centre of mass is within 0.03
    body heights of an edge of its base."""
    built = pawn(gaussian_count=3000)
    means = built.cloud.means.numpy()
    means[:, 0] += lean * means[:, 2]
    cloud = replace(built.cloud, means=wp.array(means, dtype=wp.vec3))
    note = balance_note(_with_one_fibre(cloud, built.plane, tmp_path, lean, strength=0.01))
    assert note is not None
    assert note.startswith("muscles: 4 segments cannot hold it upright: it tilts by ")
    assert "\n" not in note


def test_a_body_that_stands_without_muscles_is_not_reported(tmp_path: Path) -> None:
    built = pawn(gaussian_count=3000)
    assert balance_note(_with_one_fibre(built.cloud, built.plane, tmp_path, 0.0, strength=0.01)) is None


def _with_one_fibre(cloud: GaussianCloud, plane: Plane, folder: Path, lean: float, *, strength: float) -> Creature:
    """Return the creature with one fibre of ``strength`` body weights along the axis of the leaning body."""
    ends = {"from": [0.1 * lean, 0.0, 0.1], "to": [0.6 * lean, 0.0, 0.6]}
    fibre = {"name": "weak", "kind": "longitudinal", "strength": strength, **ends}
    file = folder / "own.json"
    file.write_text(json.dumps({"fibres": [fibre]}))
    options = CreatureOptions(nodes=50, muscles_file=file, front=np.array([1.0, 0.0, 0.0]))
    return make_creature(cloud, plane=plane, options=options)


@pytest.mark.slow
@pytest.mark.parametrize("line", ["info pawn.ply", "muscles pawn.ply --plot out.png", "animate pawn.ply --out out"])
def test_every_command_checks_the_muscles_of_a_file(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], coarse: None
) -> None:
    monkeypatch.chdir(tmp_path)
    write_ply(tmp_path / "pawn.ply", pawn(gaussian_count=2000).cloud)
    fibre = {"name": "spine", "kind": "longitudinal", "from": [0, 0, 0.1], "to": [0, 0, 0.6]}
    (tmp_path / "own.json").write_text(json.dumps({"fibres": [fibre]}))
    monkeypatch.setattr(balance, "_IMPULSE", 6.0)
    flags = ["--frames", "2", "--size", "16"] if line.startswith("animate") else []
    assert main([*line.split(), "--up", "z", "--muscles", "own.json", *flags]) == 0
    said = capsys.readouterr()
    assert "muscles: 4 segments cannot hold it upright: it tilts by " in said.out + said.err


def test_a_body_that_cannot_stand_is_warned_about_before_the_simulation() -> None:
    """The points that carry the pawn are moved by half a height, so that its centre of mass is outside of them."""
    place = initial_stance(coarse_pawn())
    assert unstable_start_notes(place) == ()
    points = place.contact_points + 0.5 * place.body.height * place.ground.axes[0]
    (note,) = unstable_start_notes(replace(place, contact_points=points))
    assert isinstance(note, Problem)
    assert re.match(r"its centre of mass is 0\.\d+ body heights outside its support, so it may tip over before", note)


def test_a_ball_is_not_warned_about_because_it_cannot_tip_over() -> None:
    """The points that carry the ball are beside its centre of mass, where the warning would apply to other bodies."""
    place = block_place(ball_mesh())
    assert place.base() is SupportKind.ROUND_BASE
    beside = replace(place, contact_points=place.contact_points + 0.5 * place.body.height * place.ground.axes[0])
    assert start_overhang(beside) > 0.0 and unstable_start_notes(beside) == ()
