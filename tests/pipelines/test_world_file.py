"""World files: mistakes are reported with their lines, and boxes and ramps have the requested sizes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from egs_warp.assets import pawn
from egs_warp.errors import UserError
from egs_warp.io.ply import write_ply
from egs_warp.pipelines.world_file import box, ramp, read_world

UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("friction: 0.6\n", "line 1: bodies is missing; give a list of bodies"),
        ("bodies:\n- capture: a.ply\n  moton: jump\n", r"line 3: bodies.1.moton: unknown key \(did you mean 'motion'"),
        ("bodies:\n- capture: a.ply\n\n  at: [0, 1, 2]\n", r"line 4: bodies.1.at: '\[0, 1, 2\]' is not valid"),
        ("bodies:\n- capture: a.ply\n- prop: true\n", "line 3: bodies.2: capture is missing; give the name"),
        ("bodies:\n- {capture: a.ply, density: 3}\n", "line 2: density is for a prop; add prop: true"),
        ("bodies:\n- {capture: a.ply, prop: true, self_contact: true}\n", "line 2: self_contact is for a creature"),
        ("bodies:\n- {capture: a.ply, motion: fly}\n", "line 2: .*fly"),
        ("bodies:\n- {capture: a.ply}\nobstacles:\n- box: {at: [0, 0]}\n", "line 4: obstacles.1.box: size is missing"),
        ("bodies:\n- {capture: missing.ply}\n", "line 2: .*missing.ply"),
        (
            "scene: missing.ply\nbodies:\n- {object: '0,0,1'}\n- {capture: a b.ply, motion: kick a-c}\n",
            r"line 4: motion 1 \('kick a-c'\): no body 'a-c'; give one of object-1",
        ),
        (
            "bodies:\n- {capture: a b.ply}\n- {capture: a b.ply, motion: jump to a-b}\n"
            "- {capture: a.ply, motion: kick b}\n",
            r"line 4: .*no body 'b'.*; give one of a-b, a-b-2",
        ),
        ("bodies:\n- {capture: a.ply, object: '0,0,1'}\n", "line 2: bodies.1: both capture and object are given"),
        ("bodies:\n- {object: '0,0,1'}\n", "line 2: object is for a scene; add scene"),
        ("bodies:\n- {capture: a.ply}\ncameras: c\n", "line 3: cameras is for a scene"),
        ("scene: a.ply\nbodies:\n- {object: '0,0,1', at: [0, 0]}\n", "line 3: at is for a body with a capture"),
        (
            "friction: 1\nbodies:\n- capture: a.ply\n  friction: 1\n",
            "line 4: bodies.1.friction: this key belongs at the top of the file, not here; remove it here, and give it"
            " once at the top",
        ),
        (
            "friction: 1\nbodies:\n  a:\n    capture: a.ply\n",
            "line 2: bodies: it is a mapping of keys to values, not a list; give a list of bodies, each with",
        ),
        ("scene: a.ply\nbodies:\n- object: 3\n", "line 3: bodies.1.object: '3' is not valid; give what selects"),
        (
            "scene: a.ply\nbodies:\n- {name: a, object: '0,0,1'}\n- {name: a, object: '1,0,1'}\n",
            "line 4: another body has the name 'a'",
        ),
        ("scene: missing.ply\nbodies:\n- {object: '0,0,1'}\n", "missing.ply"),
        (
            "bodies:\n- {capture: a.ply}\njoints:\n- {body: b, at: [0, 0, 1]}\n",
            r"line 4: joint of 'b': the world has no such body; give one of a$",
        ),
        ("bodies:\n- {capture: a.ply}\njoints:\n- {body: a, at: [0, 1]}\n", "line 4: joints.1.at: '.0, 1.' is not"),
        (
            "bodies:\n- {capture: a.ply}\nfrictions:\n- {between: [a, b], friction: 0}\n"
            "- {between: [b, a], friction: 0}\n",
            "line 5: frictions a and b: the pair is given twice",
        ),
        ("bodies: [a\n", "not YAML"),
        ("bodies:\n- capture: a.ply\n  1: 2\n", "line 3: bodies.1.1: unknown key"),
        ("bodies:\n- capture: a.ply\n  name: 12\n", "line 3: bodies.1.name: 12 is not a string; put it in quotes"),
        ("bodies:\n- capture: a.ply\n  at: [.nan, 0]\n", "line 3: bodies.1.at.1: '.nan' is not valid"),
        ("bodies:\n- capture: a.ply\n  heading: 045\n", "line 3: bodies.1.heading: '045' is not valid; give degrees"),
        (
            "bodies:\n- capture: a.ply\n  at: [1e999, 0]\n",
            "line 3: not YAML .1e999 is not a finite number.; correct it",
        ),
        ("bodies:\n\t- capture: a.ply\n", "line 2: not YAML .*indent with spaces, not tabs"),
        ("bodies: []\nbodies: []\n", "occurs twice"),
    ],
)
def test_mistakes_are_reported_with_their_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "world.yaml"
    path.write_text(text)
    with pytest.raises(UserError, match=message) as caught:
        read_world(path, device="cpu")
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


def test_a_box_and_a_ramp_have_their_size() -> None:
    solid = box((1.0, 0.0), (0.4, 0.2, 0.3), heading=90.0)
    heights = [solid.distance_along(np.array([x, y, 0.0]), UP) for x, y in ((1.0, 0.0), (1.09, 0.19), (1.15, 0.0))]
    assert heights == pytest.approx([0.3, 0.3, -np.inf])
    slope = ramp((0.0, 0.0), 2.0, 1.0, 0.5)
    heights = [slope.distance_along(np.array([x, 0.0, 0.0]), UP) for x in (-0.1, 1.0, 1.9, 2.1)]
    assert heights == pytest.approx([-0.025, 0.25, 0.475, -np.inf])


def test_a_joint_ties_its_bodies_and_its_error_names_its_line(tmp_path: Path) -> None:
    write_ply(tmp_path / "pawn.ply", pawn(gaussian_count=3000, device="cpu").cloud)
    path = tmp_path / "world.yaml"
    text = "bodies:\n- {capture: pawn.ply, up: z, prop: true, above: 1}\njoints:\n- {body: pawn, at: [0, 0, 1.9]}\n"
    path.write_text(text)
    (joint,) = read_world(path, device="cpu").world.joints
    assert joint.bodies == ("pawn",) and joint.point_joint.place == pytest.approx([0.0, 0.0, 1.9])
    path.write_text(text + "- {body: pawn, at: [0, 0, 0.5]}\n")
    with pytest.raises(UserError, match=r"line 5: joint at \(0\.00, 0\.00, 0\.50\): this is 0\.5 m outside pawn"):
        read_world(path, device="cpu")


def test_the_points_of_a_path_are_places_and_keep_what_they_leave_out(tmp_path: Path) -> None:
    scene = pawn(gaussian_count=3000, device="cpu")
    write_ply(tmp_path / "pawn.ply", scene.cloud)
    path = tmp_path / "world.yaml"
    path.write_text(
        "bodies:\n- {capture: pawn.ply, up: z, prop: true, at: [1, 2], above: 0.1, heading: 10, repeat: true,\n"
        "   path: [{time: 1, above: 0.5}, {time: 2, at: [3, 2], heading: 100}, {time: 3, at: [1, 2], above: 0.1,"
        " heading: 10}]}\n"
    )
    (placed,) = read_world(path, device="cpu").world.members
    given = placed.path
    assert given is not None and given.repeat and list(given.times) == [1, 2, 3]
    np.testing.assert_allclose(given.shifts, [[0.0, 0.0, 0.4], [2.0, 0.0, 0.4], [0.0, 0.0, 0.0]])
    assert given.turns == [0.0, 90.0, 0.0]


def test_self_contact_is_a_key_of_a_creature(tmp_path: Path) -> None:
    write_ply(tmp_path / "pawn.ply", pawn(gaussian_count=3000, device="cpu").cloud)
    path = tmp_path / "world.yaml"
    entry = "capture: pawn.ply, up: z, nodes: 50"
    path.write_text(f"bodies:\n- {{{entry}, self_contact: true}}\n- {{{entry}, at: [3, 0]}}\n")
    world = read_world(path, device="cpu").world
    assert [member.self_contact for member in world.members] == [True, False]
    assert [body.self_contact for body in world.stepper().bodies] == [True, False]


def test_a_table_of_frictions_has_the_materials_of_the_bodies(tmp_path: Path) -> None:
    write_ply(tmp_path / "pawn.ply", pawn(gaussian_count=3000, device="cpu").cloud)
    path = tmp_path / "world.yaml"
    table = (
        "friction: 0.5\nfrictions:\n- {between: [ice, wood], friction: 0.1}\n- {between: [ice, ground], friction: 0}\n"
    )
    entry = "capture: pawn.ply, up: z, prop: true"
    text = f"{table}bodies:\n- {{{entry}, material: ice}}\n- {{{entry}, at: [3, 0], material: wood}}\n"
    path.write_text(text)
    world = read_world(path, device="cpu").world
    np.testing.assert_allclose(world.frictions, [[0.5, 0.1], [0.1, 0.5]])
    assert [member.body.geometry.friction for member in world.members] == [0.0, 0.5]
    path.write_text(text.replace("material: wood", "material: woood"))
    with pytest.raises(
        UserError, match=r"line 7: pawn-2: no friction is given for the material 'woood' \(did you mean"
    ):
        read_world(path, device="cpu")
