"""Arguments of ``make_creature`` and ``simulate`` in the Python API, such as captures, axes by name, scripts and
motions that the user defines."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import egs_warp as egs
from egs_warp.assets import pawn
from egs_warp.motions.sequence import Stance
from egs_warp.pipelines.placed_cage import PlacedCage, estimated_up
from tests.support.ply_variants import columns_of, ply_of


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> egs.Capture:
    """Read a small pawn with z up from a file that does not define the up direction."""
    path = tmp_path_factory.mktemp("capture") / "pawn.ply"
    egs.write_ply(path, pawn(gaussian_count=1500, device="cpu").cloud)
    return egs.read_capture(path)


@pytest.fixture(scope="module")
def creature(capture: egs.Capture) -> egs.Creature:
    return egs.make_creature(capture, options=egs.CreatureOptions(nodes=60))


def test_a_creature_is_made_of_a_capture_alone(creature: egs.Creature) -> None:
    """The up direction is estimated as by the command ``animate``, and a note reports it."""
    note, _, front = creature.notes
    assert note.startswith("up is estimated as +z (guessed: ") and note.endswith(
        "; if that is wrong, pass another up direction"
    )
    assert front.startswith("front is taken to be ")
    assert repr(creature).splitlines()[1:] == [f"  note: {each}" for each in creature.notes]
    np.testing.assert_allclose(creature.frame.axes[2], [0.0, 0.0, 1.0])


@pytest.mark.parametrize(
    ("comments", "note"),
    [
        (["Vertical axis: z"], "up is +z (the file defines it); if that is wrong, give --up"),
        (
            ["Exported from Brush", "Vertical axis: z"],
            "up is estimated as +z (the file names the axis z, and its direction is guessed); if that is wrong, give"
            " --up",
        ),
    ],
)
def test_a_file_may_define_up(comments: list[str], note: str, capture: egs.Capture, tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(ply_of(columns_of(capture), comments=comments))
    up, said = estimated_up(egs.read_capture(tmp_path / "a.ply"), advice="give --up")
    assert (up.tolist(), said) == ([0.0, 0.0, 1.0], note)


@pytest.mark.parametrize("up", ["z", "+Z", " z ", [0, 0, 2], np.array([0.0, 0.0, 1.0])])
def test_up_is_an_axis_or_three_numbers(up: Any, capture: egs.Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    class PlacedError(Exception):
        pass

    def place(*_: Any, up: np.ndarray, **__: Any) -> PlacedCage:
        raise PlacedError(up / np.linalg.norm(up))

    monkeypatch.setattr("egs_warp.pipelines.creature.place_cage", place)
    with pytest.raises(PlacedError) as placed:
        egs.make_creature(capture, up=up)
    np.testing.assert_array_equal(placed.value.args[0], [0.0, 0.0, 1.0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"up": "w"}, "up w: give three numbers or one of x, y, z, -x, -y, -z"),
        ({"up": [1, 2]}, r"up \[1, 2\]: give three numbers or one of"),
        ({"up": [0, 0, 0]}, r"up \[0, 0, 0\]: give three numbers"),
    ],
)
def test_what_is_wrong_is_named(arguments: dict[str, Any], message: str, capture: egs.Capture) -> None:
    with pytest.raises(egs.UserError, match=message):
        egs.make_creature(capture, **arguments)


@dataclass(frozen=True)
class Record:
    seconds: float


class Still:
    """User-defined motion without objectives, which is at rest after ``expected_time``."""

    expected_time = 0.05

    def __init__(self, stance: Stance) -> None:
        self.stance, self.begin, self.is_at_rest = stance, None, False

    def objectives(self, state: Any, report: Any, dt: float) -> Sequence[Any]:
        self.begin = state.time if self.begin is None else self.begin
        self.is_at_rest = state.time - self.begin >= self.expected_time
        return []

    def plan_record(self) -> Record:
        return Record(self.expected_time)

    def planned_com(self, elapsed: float) -> None:
        return None

    def outcome_record(self, trajectory: egs.Trajectory, first: int, last: int) -> None:
        return None

    def notes(self) -> list[str]:
        return ["nothing was to be done"]


def test_the_motion_of_the_guide_sways_to_the_left_first(creature: egs.Creature) -> None:
    guide = (Path(__file__).parents[2] / "docs" / "motions" / "scripts.md").read_text()
    (code,) = [block for block in re.findall(r"```python\n(.*?)```", guide, re.DOTALL) if "def sway" in block]
    names: dict[str, Any] = {}
    exec(code, names)
    run = egs.simulate(creature, names["script"], frames=40)
    assert [request.name for request in names["script"].requests] == ["sway", "nod"]
    mass, left = run.trajectory.node_mass, run.place.ground.axes[1]
    displacement = (mass / mass.sum()) @ (run.frames - run.frames[0]) @ left / run.creature.body.height
    assert 0.02 < displacement.max() < 0.06 and displacement.min() > -0.01


def test_a_motion_of_ones_own_needs_no_file(creature: egs.Creature, capture: egs.Capture, tmp_path: Path) -> None:
    own: Any = Still
    script = egs.own_script("wait", own, seconds=1.0) + egs.motion("stand 0.05")
    performance = egs.simulate(creature, script, frames=8)
    assert [record.name for record in performance.sequence.done] == ["wait", "stand"]
    assert repr(performance) == f"SimulatedRun(wait, stand: 8 frames, {7 / 60:.2f} s)"
    key = egs.Key(0.1, "head", egs.Quantity.POSITION, (0.01, 0.0, 0.0))
    trajectory = egs.simulate(creature, egs.keyframe_script(key), frames=8).sequence.done[0]
    assert trajectory.motion.plan_record().worst_miss["position"] < 0.02  # type: ignore[attr-defined]
    with pytest.raises(egs.UserError, match="part 'haed' is unknown \\(did you mean 'head'\\?\\)"):
        egs.keyframe_script(egs.Key(0.1, "haed", egs.Quantity.POSITION, (0.0, 0.0, 0.0)))
    with pytest.raises(egs.UserError, match="name jump: give at most 60 letters, digits, spaces, hyphens"):
        egs.own_script("jump", own, seconds=1.0)
    with pytest.raises(egs.UserError, match="seconds 0: give a time above 0"):
        egs.own_script("wait", own, seconds=0)
    with pytest.raises(egs.UserError, match=r"distance 1\.0: the motion is a script, which contains its own targets"):
        egs.animate(capture, tmp_path, motion=script, options=egs.AnimateOptions(distance=1.0))
    assert len(egs.simulate(creature, "stand 0.05", frames=2).frames) == 2


def test_a_run_has_the_report_that_animate_writes(creature: egs.Creature) -> None:
    report = egs.simulate(creature, "stand 0.05, twist 90", frames=3).report(asked={"who": "me"})
    assert [motion.name for motion in report.motion] == ["stand"] and report.asked == {"who": "me"}
    assert report.summary().splitlines()[-1] == "audit: passed"
    assert any("twist" in note for note in report.notes), "the motion that did not start is named"


def test_a_cage_with_many_more_nodes_than_requested_is_noted(
    capture: egs.Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    built: list[tuple[int, tuple[str, ...]]] = []

    def creature_in_cage(_: Any, standing: PlacedCage, *__: Any, notes: tuple[str, ...], **___: Any) -> None:
        built.append((len(standing.cage.mesh.nodes), notes))

    monkeypatch.setattr("egs_warp.pipelines.creature.creature_in_cage", creature_in_cage)
    for nodes in (60, 400):
        egs.make_creature(capture, up="z", options=egs.CreatureOptions(nodes=nodes))
    (few, noted), (many, silent) = built
    assert few > 1.25 * 60
    (note,) = noted
    assert note.startswith(f"the simulation takes longer: the cage needs {few} nodes instead of 60 to enclose ")
    assert many <= 1.25 * 400 and silent == ()


def test_an_overlap_without_effect_is_a_warning_at_the_line_of_the_user(creature: egs.Creature) -> None:
    with pytest.warns(UserWarning, match="overlap 0.2 of the style has no effect") as issued:
        egs.simulate(creature, "jump 0.1 0.05", frames=2, style=egs.Style(overlap=0.2))
    assert issued[0].filename == __file__


def test_a_poor_capture_is_warned_of(capture: egs.Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("egs_warp.pipelines.capture_warnings.MIN_GAUSSIANS", 1_000_000)
    with pytest.warns(egs.CaptureWarning, match=r"only \d+ Gaussians: most of the body is guessed") as issued:
        creature = egs.make_creature(capture, up="z", options=egs.CreatureOptions(nodes=60, front="x"))
    assert issued[0].filename == __file__ and creature.notes[-1] == str(issued[0].message)


def test_a_style_needs_a_motion_that_jumps(creature: egs.Creature) -> None:
    world = egs.World()
    world.add(creature)
    heavy = egs.Style(squash=1.4)
    refused = (
        "style: no motion of 'nod' jumps; these have a style: jump, hop, twist, dance, skip, spin, backflip,"
        " front flip, land and pose"
    )
    for call in (
        lambda: egs.simulate(creature, "nod", frames=2, style=heavy),
        lambda: egs.simulate(world, {"creature-1": "nod"}, frames=2, style=heavy),
        lambda: egs.Job("nod", style=heavy),
    ):
        with pytest.raises(egs.UserError, match=f"^{refused}$"):
            call()
    assert egs.simulate(creature, "nod", frames=2, style=egs.Style()).sequence.done


def test_what_a_user_prints_is_a_short_line(creature: egs.Creature, capture: egs.Capture, tmp_path: Path) -> None:
    run = egs.simulate(creature, "stand 0.05", frames=2)
    embedding = egs.embed_gaussians(creature.cloud, creature.cage.mesh)
    deformer, camera = egs.Deformer(creature.cloud, embedding), run.camera(64)
    count, nodes = f"{capture.count:,} Gaussians", len(creature.cage.mesh.nodes)
    fibres = creature.muscles.fibre_count
    (push,) = egs.read_pushes("0.5 0.1 left")
    for record, text in [
        (capture, f"Capture('pawn.ply', INRIA .ply: {count}, SH degree 3)"),
        (capture.cloud, f"GaussianCloud({count}, SH degree 3)"),
        (replace(creature, notes=()), f"Creature({count}, {nodes} nodes, {fibres} muscle fibres, 1 m tall)"),
        (run, "SimulatedRun(stand: 2 frames, 0.02 s)"),
        (run.ending, "EndCause(not ended early)"),
        (replace(run, fallen="it tripped").ending, "EndCause(fallen: it tripped)"),
        (run.sequence, "MotionSequence(stand; 0 of 1 not started)"),
        (run.trajectory, f"Trajectory(0.00 to 0.02 s, 2 states of {nodes} nodes)"),
        (deformer, f"Deformer({count})"),
        (
            egs.motion("hop x3 distance=0.5 + nod at=0.2"),
            "Script(hop x3 distance=0.5 height=0.3 + nod degrees=0 count=2 branch=0 at=0.2)",
        ),
        (egs.Plane(np.array([0.0, 0.0, 1.0]), -0.25), "Plane(normal=[0, 0, 1], offset=-0.25)"),
        (egs.ObjectSpec(point=np.array([0.0, 0.0, 0.5])), "ObjectSpec(point=[0, 0, 0.5])"),
        (push, "Push(time=0.5, impulse=[0, 0.1, 0])"),
        (egs.CreatureOptions(nodes=60), "CreatureOptions(nodes=60)"),
        (egs.World(), "World(empty)"),
        (egs.VideoWriter(tmp_path / "a.mp4", 64, 32), f"VideoWriter('{tmp_path / 'a.mp4'}', 64 x 32 pixels)"),
    ]:
        assert repr(record) == text
    others = (
        run.simulation,
        run.records[0],
        run.place,
        embedding,
        camera,
        egs.render_gaussians(creature.cloud, camera),
    )
    for record in (
        *others,
        deformer.deform(run.frames[0]),
        *(getattr(creature, each.name) for each in fields(creature) if each.name != "notes"),
    ):
        assert len(repr(record)) < 500 and "\n" not in repr(record) and " at 0x" not in repr(record)


def test_no_public_record_prints_the_numbers_of_its_arrays() -> None:
    """A public dataclass with arrays does not have the text that ``dataclass`` generates."""
    for kind in (getattr(egs, name) for name in egs.__all__):
        if not is_dataclass(kind) or not hasattr(kind.__repr__, "__wrapped__"):
            continue
        types = " ".join(str(each.type) for each in fields(kind))
        assert not re.search("ndarray|wp.array|Direction|GaussianCloud", types), kind


def test_warp_starts_silently_unless_it_is_asked_to_speak(capture: egs.Capture) -> None:
    """Warp prints its banner of seven lines and its warning about a missing driver only if the user sets a log
    level."""
    script = "import warp as wp; {}import egs_warp as egs; egs.read_capture({!r})"
    for asked, is_silent in (("", True), ("wp.config.log_level = wp.LOG_DEBUG; ", False)):
        command = [sys.executable, "-c", script.format(asked, str(capture.source))]
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=dict(os.environ))
        assert (done.stdout + done.stderr == "") == is_silent
