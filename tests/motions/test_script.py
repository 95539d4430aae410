"""Scripts as one line of motions or as a JSON file, with a one-line error for every mistake."""

from __future__ import annotations

from pathlib import Path

import pytest

from egs_warp.errors import UserError
from egs_warp.motions.act import Act
from egs_warp.motions.command import Drive
from egs_warp.motions.names import NAMES
from egs_warp.motions.repertoire import MOTIONS
from egs_warp.motions.script import drive_script, motion
from egs_warp.motions.sequence import Stance
from egs_warp.motions.style import read_style
from egs_warp.motions.walk import Walk

KNOWN = (
    "jump, hop, twist, walk, walk to, walk along, run, turn, drive, stand, get up, dance, trajectory, nod, shake,"
    " look around, wave, bow, groove, sneak, skip, spin, backflip,"
    " front flip, 'land and pose'"
)


def test_a_line_of_motions() -> None:
    hop, twist, walk, jump = motion("hop x3, twist -90 height=0.3,walk 2, JUMP 1 0.25").requests
    assert (hop.name, hop.repeat, hop.asked) == ("hop", 3, {"distance": 0.7, "height": 0.3})
    assert twist.asked == {"heading_degrees": -90.0, "distance": 0.0, "height": 0.3}
    assert (walk.name, walk.asked["distance"], walk.repeat) == ("walk", 2.0, 1)
    assert (jump.name, jump.asked) == ("jump", {"distance": 1.0, "height": 0.25})


def test_flags_are_defaults_of_motions_that_take_them() -> None:
    flags = {"distance": 0.6, "heading_degrees": 45.0, "height": None}
    jump, twist, hop = motion("jump, twist distance=0, hop 0.8", **flags).requests
    assert jump.asked == {"distance": 0.6, "height": 0.2}
    assert twist.asked == {"heading_degrees": 45.0, "distance": 0.0, "height": 0.2}
    assert hop.asked["distance"] == 0.8
    with pytest.raises(UserError, match=r"^heading_degrees: no motion of 'jump' takes this number; jump takes dis"):
        motion("jump", heading_degrees=30.0)


def test_a_json_script_is_the_same_as_its_line(tmp_path: Path) -> None:
    path = tmp_path / "dance.json"
    path.write_text(
        '[{"motion": "hop", "repeat": 2, "distance": 0.5}, {"motion": "twist", "heading_degrees": 90},'
        ' {"motion": "trajectory", "file": "keys.csv"}]'
    )
    assert motion(str(path)) == motion(f"hop 0.5 x2, twist 90, trajectory {tmp_path / 'keys.csv'}")


def test_gestures_run_on_top_of_a_motion(tmp_path: Path) -> None:
    """In a line, ``+`` adds a gesture that begins ``at`` seconds after the start of the motion; in JSON, ``with`` lists
    the gestures."""
    walk, look = motion("walk 1 + wave 60 at=0.5 + nod count=3, look around 40 + nod at=2").requests
    assert (walk.name, walk.asked["distance"]) == ("walk", 1.0)
    waves, nods = walk.layers
    assert (waves.begin, waves.request.name, waves.request.asked["degrees"]) == (0.5, "wave", 60.0)
    assert (nods.begin, nods.request.asked) == (0.0, {"degrees": 0.0, "count": 3.0, "branch": 0.0})
    assert look.name == "look around" and look.asked == {"degrees": 40.0, "branch": 0.0} and look.layers[0].begin == 2.0
    assert motion("look around").file_stem == "look-around" and motion("jump, nod").file_stem == "motions"
    path = tmp_path / "acting.json"
    path.write_text(
        '[{"motion": "walk", "distance": 1, "with": [{"motion": "wave", "degrees": 60, "at": 0.5},'
        ' {"motion": "nod", "count": 3}]}]'
    )
    assert motion(str(path)).requests == (walk,)
    assert motion("jump + nod at=20").frames() == 60 * 20 + motion("nod").frames()


def test_only_a_motion_can_be_added_to_a_motion() -> None:
    assert (motion("jump") + motion("nod")).requests == motion("jump, nod").requests
    with pytest.raises(UserError, match=r"^motion \+ 'nod': give another motion, such as egs.motion\('nod'\)$"):
        motion("jump") + "nod"  # pyright: ignore[reportOperatorIssue]


def test_a_spin_is_measured_as_a_heading(place: Stance) -> None:
    (spin,) = motion("spin 2").parts(1.0)
    assert spin.asked == {"turns": 2.0, "height": 0.2, "heading_degrees": 720.0}
    assert motion("land and pose 0.3 seconds=2").requests[0].asked == {"distance": 0.3, "height": 0.25, "seconds": 2.0}
    (sneak,) = motion("sneak 0.2").parts(1.0)
    begun = sneak.begin(place)
    assert isinstance(begun, Act) and isinstance(begun.below, Walk)
    assert begun.below.gait.swing_time > motion_walk(place).gait.swing_time


def motion_walk(place: Stance) -> Walk:
    (walk,) = motion("walk 0.2").parts(1.0)
    begun = walk.begin(place)
    assert isinstance(begun, Walk)
    return begun


def test_a_run_is_the_quickest_walk_by_the_longest_paces(place: Stance) -> None:
    (run,), (walk,) = (motion(text).parts(1.0) for text in ("run 0.5", "walk 0.5"))
    fast, usual = run.begin(place), walk.begin(place)
    assert isinstance(fast, Walk) and isinstance(usual, Walk)
    assert fast.gait.swing_time == pytest.approx(usual.gait.swing_time / 1.6)
    assert fast.gait.step_count <= usual.gait.step_count and fast.planar_poses[-1] == pytest.approx(
        usual.planar_poses[-1]
    )


def test_motions_without_parameters_reject_numbers() -> None:
    with pytest.raises(UserError, match="'2' is one value too many; get up takes no numbers"):
        motion("get up 2")


def test_speeds_come_from_a_file_or_from_commands(place: Stance, tmp_path: Path) -> None:
    (tmp_path / "speeds.csv").write_text("0,0.1,0,0\n1,0,0,0\n")
    read, given = motion(f"drive {tmp_path / 'speeds.csv'}"), drive_script((0.0, Drive(0.1)), (1.0, Drive()))
    assert read.name == given.name == "drive" and read.frames() == given.frames() == 360
    (part,), (other,) = read.parts(1.0), given.parts(1.0)
    assert part.asked == other.asked == {"commands": 2.0, "duration": 1.0}
    assert part.begin(place).expected_time == pytest.approx(other.begin(place).expected_time)
    with pytest.raises(UserError, match=r"drive needs a file of speeds, as in drive speeds\.csv"):
        motion("drive")


def test_motions_along_paths_are_parsed(tmp_path: Path) -> None:
    """A comma between two numbers does not end a motion; a path is read from a file; a negative distance means
    backwards."""
    to, back, turned, along = motion("walk to 1.5,-0.5, walk -1 speed=1.2,turn -90, walk along a.csv 0.05").requests
    assert (to.name, to.asked["ahead"], to.asked["left"], to.asked["speed"]) == ("walk to", 1.5, -0.5, 1.0)
    assert motion("walk to 1 2").requests[0].asked["left"] == motion("walk to 1, 2").requests[0].asked["left"] == 2.0
    assert (back.asked["distance"], back.asked["speed"]) == (-1.0, 1.2)
    assert (turned.name, turned.asked["heading_degrees"]) == ("turn", -90.0)
    assert (along.name, along.file, along.asked["step_length"]) == ("walk along", Path("a.csv"), 0.05)
    (part,) = motion("walk to 3,4").parts(1.0)
    assert part.asked["distance"] == 5.0


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            "walk + hop",
            "motion 1 ('walk + hop'): hop is not a gesture; gestures are: nod, shake, look around, wave, bow, ",
        ),
        ("walk + nod x2", "motion 1 ('walk + nod x2'): nod on top of a motion cannot be repeated; add it once more"),
        ("walk + nod at=-1", "motion 1 ('walk + nod at=-1'): at -1: give a number of seconds from 0 to 60"),
        ("walk + nod at=1 at=2", "motion 1 ('walk + nod at=1 at=2'): at= is given twice; give it once"),
        ("walk + ", "motion 1 ('walk +'): nothing after +; name a gesture: nod, shake, look around"),
        ("fly", f"motion 1: unknown motion 'fly'; known motions are: {KNOWN}"),
        ("jump, walk to", "motion 2 ('walk to'): walk to needs a target in body heights ahead and to the left, as in "),
        ("walk to left=1", "walk to needs a target"),
        ("jump,", "motion 2: it is empty; remove a comma, or name a motion: jump, hop, twist, walk, walk to"),
        (" ", "motion: the text is empty; name a motion: jump, hop"),
        ("jump 50cm", "distance 50cm: give a number of body heights from 0 to 10, without a unit; 1 is the height of"),
        ("turn 90deg", "heading_degrees 90deg: give a number of degrees from -720 to 720, without a unit"),
        ("hop x0", "motion 1 ('hop x0'): repeat 0; give a whole number from 1 to 100"),
        ("jump 1 2 3", "motion 1 ('jump 1 2 3'): '3' is one value too many; jump takes distance, height"),
        ("hop, jump far", "motion 2 ('jump far'): distance far: give a number of body heights from 0 to 10"),
        (
            "jump then walk",
            "motion 1 ('jump then walk'): 'then' is not a number; separate motions by commas, and add a gesture on top"
            " of a motion by +, as in 'jump, walk 1 + nod'",
        ),
        ("walk 1 0.1 1 Wave", "motion 1 ('walk 1 0.1 1 Wave'): 'Wave' is not a number; separate motions by commas"),
        ("land", "motion 1: unknown motion 'land' (did you mean 'land and pose'?); known motions are: jump, hop, "),
        ("jump height=", "('jump height='): height without a value: give a number of body heights above 0 up to 10"),
        ("jump nan", "motion 1 ('jump nan'): distance nan: give a number of body heights from 0 to 10"),
        ("twist 9999", "('twist 9999'): heading_degrees 9999: give a number of degrees from -720 to 720"),
        ("jump height=0", "('jump height=0'): height 0: give a number of body heights above 0 up to 10"),
        ("walk 99", "('walk 99'): distance 99: give a number of body heights from -10 to 10"),
        ("walk to 1,2,3,4,5", "'5' is one value too many; walk to takes ahead, left, step_length, speed"),
        ("walk to there", "('walk to there'): ahead there: give a number of body heights"),
        ("walk along", "('walk along'): walk along needs a file of points, as in walk along way.csv"),
        ("turn 45 9", "('turn 45 9'): speed 9: give a number of times the usual from 0.3 to 1.6"),
        ("jump speed=2", "('jump speed=2'): 'speed' is unknown; jump takes distance, height"),
        ("trajectory", "('trajectory'): trajectory needs a file of key frames, as in trajectory keys.json"),
        ("hop x60, hop x60", "motion: 120 motions are given; at most 100 are allowed"),
        ("jump x2 x3", "('jump x2 x3'): 'x3' is a second number of repeats; give one"),
        ("jump x" + 5000 * "9", "repeat inf; give a whole number from 1 to 100"),
        ("jump distance=1 distance=2", "distance is given twice; give it once"),
        ("jump 1 distance=2", "distance is given twice; give it once"),
        ("none.json", "none.json: no such file or folder; check the path"),
    ],
)
def test_mistakes_of_a_line(line: str, message: str) -> None:
    with pytest.raises(UserError) as error:
        motion(line)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("value", ["-inf", "-far", "+.x"])
def test_a_value_without_digits_is_no_number_with_a_unit(value: str) -> None:
    with pytest.raises(UserError, match=r"give a number of degrees from -720 to 720$"):
        motion(f"turn {value}")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[", "not JSON at line 1"),
        ("[" * 100_000, "its lists are nested too deeply; write fewer levels"),
        ("{}", 'it contains {}; give a list of motions, such as [{"motion": "jump"}]'),
        ("[3]", f', motion 1 is 3; give an object with a "motion", one of {KNOWN}'),
        ('[{"motion": "walk", "with": 3}]', ', motion 1: "with" is 3; give a list of gestures'),
        (
            '[{"motion": "walk", "with": "' + 100 * "\\u00fc" + '"}]',
            f', motion 1: "with" is "{59 * "ü"} ...; give a list of gestures',
        ),
        (
            '[{"motion": "walk", "with": ["nod"]}]',
            ', motion 1: "with" contains "nod"; give a "motion" for each gesture, one of nod,',
        ),
        ('[{"motion": "walk", "with": [{"motion": "hop"}]}]', ", motion 1: hop is not a gesture; gestures are: nod,"),
        ('[{"motion": "jump", "repeat": 1.5}]', ', motion 1: "repeat" is 1.5; give a whole number'),
        ('[{"motion": "jump", "distance": true}]', "distance True: give a number of body heights from 0 to 10"),
        ('[{"motion": "trajectory", "file": 3}]', '"file" is 3; give the name of a file'),
        ('[{"motion": "jump", "file": "a.csv"}]', "jump takes distance, height"),
        ('[{"motion": "jump", "distance": "0.5"}]', '"distance" is the text "0.5"; give a number without quotes'),
        (
            f'[{{"motion": "jump", "distance": {401 * "1"}}}]',
            "distance inf: give a number of body heights from 0 to 10",
        ),
        ('[{"motion": "jump", "style": 2}]', ', motion 1: "style" is 2; give a string, such as "heavy"'),
        (
            '[{"motion": "hop"}, {"motion": "jump", "style": "floppy"}]',
            ", motion 2: style: unknown word 'floppy'; give",
        ),
        ('[{"motion": "jump", "style": "overlap=0.2"}]', ", motion 1: overlap is a property of the whole run; give it"),
        ('[{"motion": "walk", "style": "heavy"}]', ", motion 1: walk does not jump, so it has no style; these have"),
        (f'[{{"motion": "jump", "repeat": {5000 * "1"}}}]', '"repeat" is inf; give a whole number'),
    ],
)
def test_mistakes_of_a_file(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "s.json"
    path.write_text(text)
    with pytest.raises(UserError) as error:
        motion(str(path))
    assert str(error.value).startswith(str(path))
    assert message in str(error.value)


def test_the_check_of_the_shape_names_every_motion_that_is_impossible(place: Stance) -> None:
    """A block has no branches; it can jump."""
    single = []
    for name in ("wave", "wave branch=2"):
        with pytest.raises(UserError) as error:
            motion(name).check_shape(place)
        single.append(str(error.value))
    with pytest.raises(UserError) as error:
        motion("wave, jump, wave branch=2, wave").check_shape(place)
    assert str(error.value) == "; ".join(single)


def test_the_check_of_the_shape_uses_the_style_of_the_jumps(place: Stance, tmp_path: Path) -> None:
    """The first beats come before the end of a crouch in the default style, and after that of a light one."""
    (tmp_path / "beats.txt").write_text("0.4\n0.75\n")
    script = motion(f"dance {tmp_path / 'beats.txt'}")
    with pytest.raises(UserError, match=r"none of the 2 beats can be reached"):
        script.check_shape(place)
    script.check_shape(place, read_style("light"))


def test_the_names_that_are_checked_without_the_mechanics_are_those_of_the_registry() -> None:
    assert tuple(MOTIONS) == NAMES
