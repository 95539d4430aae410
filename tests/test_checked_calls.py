"""``egs_warp.checked_calls``: wrong calls of the public interface are explained in one line."""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_type_hints

import numpy as np
import pytest

import egs_warp as egs
from egs_warp.checked_calls import (
    Finite,
    Fraction,
    Range,
    checked_constructor,
    checked_function,
    checked_method,
    is_options,
)
from egs_warp.motions.style import Style

if TYPE_CHECKING:
    from egs_warp.fem.body import BodyState


class Rule(Enum):
    KEEP = "keep"
    CUT = "cut"


@dataclass(frozen=True)
class Inner:
    nodes: int = 500
    size: int = 1


@checked_constructor
@dataclass(frozen=True)
class Outer:
    size: int = 2
    rule: Rule = Rule.KEEP
    parts: tuple[Inner, ...] = ()
    inner: Inner = field(default_factory=Inner)

    @checked_method
    def scaled(self, factor: float) -> Outer:
        return replace(self, size=int(factor * self.size))

    @classmethod
    @checked_method
    def read(cls, file: Path) -> Outer:
        return cls(size=len(file.name))


@checked_constructor
@dataclass(frozen=True, kw_only=True)
class Options:
    nodes: int = 500


def _make(
    style: Style,
    plane: int | None = None,
    *,
    point: Annotated[np.ndarray, 3] | None = None,
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0),
    file: Path | None = None,
    fast: bool = False,
    weights: Sequence[float] | Mapping[str, float] = (),
    progress: Callable[[int], object] = print,
    options: Outer | None = None,
    label: BodyState | None = None,
    **values: float,
) -> dict[str, Any]:
    return {"point": point, "colour": colour, "file": file, "weights": weights, "options": options, **values}


make: Callable[..., Any] = checked_function(_make)
outer: Callable[..., Any] = Outer
options: Callable[..., Any] = Options
style = Style()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: make(), "_make: style is missing; give a Style (read_style returns one)"),
        (lambda: make("toy.ply"), "_make: style is 'toy.ply'; give a Style (read_style returns one)"),
        (lambda: make(Style), "_make: style is the class Style; give a Style (read_style returns one)"),
        (lambda: make(style, 1, 2), "_make: arguments by position: 3 given, 2 allowed; by name, _make takes style, p"),
        (lambda: make(style, 1.5), "_make: plane is 1.5; give a whole number"),
        (lambda: make(style, "z"), "_make: plane is 'z'; give a whole number"),
        (lambda: make(style, point="top"), "_make: point is 'top'; give an array of numbers"),
        (lambda: make(style, point=["a", 1]), "_make: point is ['a', 1]; give an array of numbers"),
        (lambda: make(style, point=[0, 1]), "_make: point is [0, 1]; give an array of numbers of shape (3,)"),
        (lambda: make(style, colour=(1, 1)), "_make: colour is (1, 1); give 3 numbers"),
        (lambda: make(style, colour=(1, 1, "a")), "_make: colour[2] is 'a'; give a number"),
        (lambda: make(style, file=3), "_make: file is 3; give a path"),
        (lambda: make(style, fast="no"), "_make: fast is 'no'; give True or False"),
        (lambda: make(style, weights=1.0), "_make: weights is 1.0; give a list of numbers or a mapping"),
        (lambda: make(style, weights=[1.0, None]), "_make: weights[1] is None; give a number"),
        (lambda: make(style, progress=True), "_make: progress is True; give a function"),
        (lambda: make(style, options={"size": 3}), "_make: options is {'size': 3}; give an Outer"),
        (lambda: make(style, distance="far"), "_make: distance is 'far'; give a number"),
        (lambda: outer(nodes=3), "Outer: there is no argument nodes; pass inner=Inner(nodes=...)"),
        (lambda: outer(siz=3), "Outer: there is no argument siz (did you mean 'size'?); Outer takes size, rule, parts"),
        (lambda: outer(distance=3), "Outer: there is no argument distance; give it to motion(distance=...)"),
        (lambda: outer().scaled("x"), "Outer.scaled: factor is 'x'; give a number"),
        (lambda: Outer.read(), "Outer.read: file is missing; give a path"),  # pyright: ignore[reportCallIssue]
        (lambda: options(500), "Options: arguments by position: 1 given, 0 allowed; by name, Options takes nodes"),
        (lambda: outer(rule="cut"), "Outer: rule is 'cut'; give Rule.KEEP or Rule.CUT"),
        (lambda: outer(parts=Inner()), "Outer: parts is an Inner; give a list of Inner"),
        (lambda: outer(parts=[Inner(), 3]), "Outer: parts[1] is 3; give an Inner"),
    ],
)
def test_a_wrong_argument_is_named_with_what_is_accepted(call: Callable[[], object], message: str) -> None:
    with pytest.raises(TypeError) as error:
        call()
    assert isinstance(error.value, egs.UserError) and str(error.value).startswith(message)


def test_lists_and_texts_become_arrays_tuples_and_paths() -> None:
    given = make(style, np.int64(3), point=[0, 0, 0.5], colour=[1, np.float32(0.5), 0], file="a.json", speed=2)
    np.testing.assert_array_equal(given["point"], [0.0, 0.0, 0.5])
    assert given["colour"] == (1, 0.5, 0) and given["file"] == Path("a.json") and given["speed"] == 2
    assert outer(parts=[Inner()]).parts == (Inner(),) and hash(outer(parts=[Inner()]))
    assert Outer.read("ab").size == 2  # pyright: ignore[reportArgumentType]


def test_correct_calls_pass_their_arguments_unchanged() -> None:
    point, weights, options = np.zeros(3), {"a": 1.0}, Outer(size=7)
    given = make(style, point=point, weights=weights, options=options)
    assert given["point"] is point and given["weights"] is weights and given["options"] is options
    assert make(style, weights=[1.0, 2.0], label="anything")["weights"] == [1.0, 2.0]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        ("egs.simulate(None, 'jump', distance=0.5)", r"argument distance; give it to motion\(distance=\.\.\.\).*; sim"),
        ("egs.simulate(None, 'jump', frame=60)", r"no argument frame \(did you mean 'frames'\?\); simulate takes crea"),
        ("egs.simulate('jump', None)", r"creature is 'jump'; give a Creature \(make_creature returns one\) or a World"),
        ("egs.CreatureOptions(node=3)", r"no argument node \(did you mean 'nodes'\?\); CreatureOptions takes metres_"),
        (
            "egs.CreatureOptions(friction='high')",
            r"CreatureOptions: friction is 'high'; give a Coulomb coefficient from 0 to 10$",
        ),
        ("egs.make_creature('a.ply')", r"cloud is 'a\.ply'; give a GaussianCloud \(read_capture returns one\)$"),
        ("egs.prepare_scene('room.ply', (0, 0, 0.5))", r"^prepare_scene: cloud is 'room\.ply'; give a GaussianCloud"),
        ("egs.show(7)", r"^show: subject is 7; give a SimulatedRun \(simulate returns one\), a Creature \(make_crea"),
        ("egs.make_creature(None, nodes=1)", r"no argument nodes; pass options=CreatureOptions\(nodes=\.\.\.\)$"),
        ("egs.animate(None, 'out', nodes=1)", r"options=AnimateOptions\(creature=CreatureOptions\(nodes=\.\.\.\)\)$"),
        ("egs.read_capture('')", "^read_capture: path is ''; give a path$"),
        ("egs.read_capture(3)", r"^read_capture: path is 3; give a path$"),
        ("egs.Camera.look_at([2, 0, 1], [0, 0, 0], [0, 0, 1], fov=3)", r"^Camera\.look_at: there is no argument fov"),
        ("egs.World().add(3)", r"^World\.add: body is 3; give a Creature \(make_creature returns one\) or a Prop \("),
        ("egs.Box([0, 0], [1, 1])", r"^Box: low is \[0, 0\]; give an array of numbers of shape \(3,\)$"),
        ("egs.SceneOptions(inpainter='telea')", r"give an Inpainter \(inpainter_by_name returns one\)$"),
        ("egs.FinetuneOptions(densification='none')", r"give Densification\.NONE or Densification\."),
        ("egs.Job('jump', pushes=[1])", r"^Job: pushes\[0\] is 1; give a Push$"),
    ],
)
def test_wrong_public_calls_are_explained(call: str, message: str) -> None:
    with pytest.raises(TypeError, match=message):
        eval(call)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        ("egs.CreatureOptions(nodes=-3)", "^nodes -3: give a whole number from 50 to 20000$"),
        ("egs.ObjectSpec()", "^object: nothing says where the object is; give one of masks, box, point and picked$"),
        (
            "egs.ObjectSpec(point=[0, 0, 0], box=egs.Box([0, 0, 0], [1, 1, 1]))",
            "^object: box and point are given; give one of",
        ),
        ("egs.Box([0, 0, 0], [1, 0, 1])", "^box from 0,0,0 to 1,0,1: give the corner with the lowest"),
        ("egs.CreatureOptions(front='ahead')", "^front ahead: give three numbers or one of x, y"),
        ("egs.CreatureOptions(gravity_up=[0, 0, 0])", "^gravity_up \\[0, 0, 0\\]: give three numbers"),
        ("egs.AnimateOptions(style='hevy')", "^style: unknown word 'hevy' .did you mean 'heavy'"),
        ("egs.AnimateOptions(view_from='left')", "^view_from left: give three numbers"),
        ("egs.Plane([0, 0, 2], 0.0)", "^normal 0,0,2: its length is 2, not 1; call Plane.from_coefficients"),
        ("egs.Solid(())", "^faces: the list is empty; give at least one Plane$"),
        (
            "egs.Camera.look_at([0, 0, 1], [0, 0, 0], [0, 0, 1], width=64, height=48)",
            "^up: it is parallel to the direction from eye to target",
        ),
        ("egs.Job('jmp')", "unknown motion 'jmp' .did you mean 'jump'"),
        ("egs.Job('nod', style=egs.Style(squash=2.0))", "^style: no motion of 'nod' jumps"),
        ("egs.Key(1.0, 'hed', egs.Quantity.POSITION, (0, 0, 0))", "^Key: part 'hed' is unknown .did you mean 'head'"),
        ("egs.scene('pawn', device='tpu')", "^device tpu: this machine has"),
        ("egs.concatenate()", "^clouds none: give at least one"),
        ("egs.write_png('a.png', np.zeros((4, 4, 3)))", "^image of type float64: give uint8 from 0 to 255"),
    ],
)
def test_wrong_values_are_refused_at_once(call: str, message: str) -> None:
    with pytest.raises(egs.UserError, match=message) as error:
        eval(call)
    assert "\n" not in str(error.value)


def test_public_functions_can_be_pickled() -> None:
    assert pickle.loads(pickle.dumps(egs.make_prop)) is egs.make_prop


def test_a_class_of_a_module_checks_its_arguments_without_the_interface() -> None:
    code = "from egs_warp.geometry.plane import Plane; print(type(Plane([0, 0, 1], 0.0).normal)); Plane(offset=1.0)"
    ran = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=Path(__file__).parents[1], check=False
    )
    assert ran.stdout == "<class 'numpy.ndarray'>\n"
    assert "Plane: normal is missing; give an array of numbers of shape (3,)" in ran.stderr


def test_arrays_of_public_classes_may_be_lists() -> None:
    assert isinstance(egs.ObjectSpec(point=[0, 0, 0.5]).point, np.ndarray)  # pyright: ignore[reportArgumentType]
    assert egs.CreatureOptions(cage_file="cage.npz").cage_file == Path("cage.npz")  # pyright: ignore


class Limited:
    """A class whose numbers have limits."""

    def __init__(
        self,
        count: Annotated[int, Range(2, 8)] = 2,
        share: Annotated[float, Range(0.0, 1.0, "a share")] | None = None,
        size: Annotated[float, Range(0.0, above=True)] = 1.0,
        colour: tuple[Fraction, Fraction] = (0.0, 1.0),
        direction: Annotated[np.ndarray, 3] | None = None,
        free: float = 0.0,
        finite: Finite = 0.0,
    ) -> None:
        self.values = (count, share, size, colour, free, finite)


limited: Callable[..., Any] = checked_constructor(Limited)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"count": -3}, "count -3: give a whole number from 2 to 8"),
        ({"count": "ten"}, "Limited: count is 'ten'; give a whole number from 2 to 8"),
        ({"share": np.float64(1.5)}, "share 1.5: give a share from 0 to 1"),
        ({"share": float("nan")}, "share nan: give a share from 0 to 1"),
        ({"size": 0}, "size 0: give a number above 0"),
        ({"size": float("inf")}, "size inf: give a finite number above 0"),
        ({"size": 10**400}, "size 1e400: give a finite number above 0"),
        ({"size": -float("inf")}, "size -inf: give a number above 0"),
        ({"count": 10**5000}, "count 1e5000: give a whole number from 2 to 8"),
        ({"size": np.str_("abc")}, "Limited: size is np.str_('abc'); give a number above 0"),
        ({"colour": (0.5, -1.0)}, "colour[1] -1: give a number from 0 to 1"),
        ({"colour": 3}, "Limited: colour is 3; give 2 numbers from 0 to 1"),
        ({"direction": [0.0, 0.0, np.nan]}, "Limited: direction is [0.0, 0.0, nan]; give finite numbers"),
        ({"free": float("nan")}, "Limited: free is nan; give a number"),
        ({"finite": float("-inf")}, "finite -inf: give a finite number"),
    ],
)
def test_numbers_outside_their_limits_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(egs.UserError) as error:
        limited(**arguments)
    assert str(error.value) == message


def test_the_limits_themselves_are_accepted() -> None:
    values = limited(8, 0.0, 1e-300, [0, 1], [0, 0, 1], float("inf"), -1e300).values
    assert values == (8, 0.0, 1e-300, (0, 1), float("inf"), -1e300)


NEEDS_GYMNASIUM = () if find_spec("gymnasium") else ("CreatureVectorEnv",)
OPTIONS = [
    record
    for record in (getattr(egs, name) for name in egs.__all__ if name not in NEEDS_GYMNASIUM)
    if is_options(record)
]


@pytest.mark.parametrize("record", [*OPTIONS, egs.Job], ids=lambda record: record.__name__)
def test_all_numbers_of_options_have_limits(record: Callable[..., Any]) -> None:
    """A new field cannot be forgotten: no number of the public options may be minus a billion."""
    required = {"motion": "jump"} if record is egs.Job else {}
    for name, hint in get_type_hints(record).items():
        if {int, float} & {hint, *get_args(hint)}:
            with pytest.raises(egs.UserError):
                record(**required, **{name: -1_000_000_000})


def test_options_cover_the_public_records() -> None:
    assert {record.__name__ for record in OPTIONS} >= {"AnimateOptions", "CreatureOptions", "FinetuneOptions", "Shot"}
