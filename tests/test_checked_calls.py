"""``egs_warp.checked_calls``: wrong calls of the public interface are explained in one line."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import pytest

import egs_warp as egs
from egs_warp.checked_calls import with_checked_arguments

if TYPE_CHECKING:
    from egs_warp.fem.body import BodyState


class Names:
    """Other names of the interface of this test."""

    def function_returning(self, class_name: str) -> str | None:
        return {"Cloud": "read_cloud"}.get(class_name)

    def callables_with(self, argument: str) -> list[str]:
        return ["read_cloud", "make_prop"] if argument == "device" else []


class Cloud:
    """Class that a function returns."""


class Rule(Enum):
    KEEP = "keep"
    CUT = "cut"


@dataclass(frozen=True)
class Inner:
    nodes: int = 500
    size: int = 1


@dataclass(frozen=True)
class Outer:
    size: int = 2
    rule: Rule = Rule.KEEP
    parts: tuple[Inner, ...] = ()
    inner: Inner = field(default_factory=Inner)


def _make(
    cloud: Cloud,
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


make: Callable[..., Any] = with_checked_arguments(_make, Names())
outer: Callable[..., Any] = with_checked_arguments(Outer, Names())
cloud = Cloud()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: make(), "_make: cloud is missing; give a Cloud (read_cloud returns one)"),
        (lambda: make("toy.ply"), "_make: cloud is 'toy.ply'; give a Cloud (read_cloud returns one)"),
        (lambda: make(Cloud), "_make: cloud is the class Cloud; give a Cloud (read_cloud returns one)"),
        (lambda: make(cloud, 1, 2), "_make: 3 arguments by position are too many, allowed are 2 (cloud, plane); give"),
        (lambda: make(cloud, 1, plane=1), "_make: plane is given twice, by position and by name; give it once"),
        (lambda: make(cloud, 1.5), "_make: plane is 1.5; give a whole number"),
        (lambda: make(cloud, "z"), "_make: plane is 'z'; give a whole number"),
        (lambda: make(cloud, point="top"), "_make: point is 'top'; give an array of numbers"),
        (lambda: make(cloud, point=["a", 1]), "_make: point is ['a', 1]; give an array of numbers"),
        (lambda: make(cloud, point=[0, 1]), "_make: point is [0, 1]; give an array of numbers of shape (3,)"),
        (lambda: make(cloud, colour=(1, 1)), "_make: colour is (1, 1); give 3 numbers"),
        (lambda: make(cloud, colour=(1, 1, "a")), "_make: colour[2] is 'a'; give a number"),
        (lambda: make(cloud, file=3), "_make: file is 3; give a path"),
        (lambda: make(cloud, fast="no"), "_make: fast is 'no'; give True or False"),
        (lambda: make(cloud, weights=1.0), "_make: weights is 1.0; give a list of numbers or a mapping"),
        (lambda: make(cloud, weights=[1.0, None]), "_make: weights[1] is None; give a number"),
        (lambda: make(cloud, progress=True), "_make: progress is True; give a function"),
        (lambda: make(cloud, options={"size": 3}), "_make: options is {'size': 3}; give an Outer"),
        (lambda: make(cloud, distance="far"), "_make: distance is 'far'; give a number"),
        (lambda: outer(nodes=3), "Outer: there is no argument nodes; pass inner=Inner(nodes=...)"),
        (lambda: outer(siz=3), "Outer: there is no argument siz (did you mean 'size'?); Outer takes size, rule, parts"),
        (lambda: outer(device=3), "Outer: there is no argument device; give it to read_cloud(device=...) or make_pr"),
        (lambda: outer(rule="cut"), "Outer: rule is 'cut'; give Rule.KEEP or Rule.CUT (did you mean Rule.CUT?)"),
        (lambda: outer(parts=Inner()), "Outer: parts is an Inner; give a list of Inner"),
        (lambda: outer(parts=[Inner(), 3]), "Outer: parts[1] is 3; give an Inner"),
    ],
)
def test_a_wrong_argument_is_named_with_what_is_accepted(call: Callable[[], object], message: str) -> None:
    with pytest.raises(TypeError) as error:
        call()
    assert isinstance(error.value, egs.UserError) and str(error.value).startswith(message)


def test_lists_and_texts_become_arrays_tuples_and_paths() -> None:
    given = make(cloud, np.int64(3), point=[0, 0, 0.5], colour=[1, np.float32(0.5), 0], file="a.json", speed=2)
    np.testing.assert_array_equal(given["point"], [0.0, 0.0, 0.5])
    assert given["colour"] == (1, 0.5, 0) and given["file"] == Path("a.json") and given["speed"] == 2
    assert outer(parts=[Inner()]).parts == (Inner(),) and hash(outer(parts=[Inner()]))


def test_correct_calls_pass_their_arguments_unchanged() -> None:
    point, weights, options = np.zeros(3), [1.0, 2.0], Outer(size=7)
    given = make(cloud, point=point, weights=weights, options=options)
    assert given["point"] is point and given["weights"] is weights and given["options"] is options
    assert make(cloud, weights={"a": 1.0}, label="anything")["weights"] == {"a": 1.0}


@pytest.mark.parametrize(
    ("call", "message"),
    [
        ("egs.simulate(None, 'jump', distance=0.5)", r"argument distance; give it to motion\(distance=\.\.\.\).*; sim"),
        ("egs.simulate(None, 'jump', frame=60)", r"no argument frame \(did you mean 'frames'\?\); simulate takes crea"),
        ("egs.simulate('jump', None)", r"creature is 'jump'; give a Creature \(make_creature returns one\) or a World"),
        ("egs.CreatureOptions(node=3)", r"no argument node \(did you mean 'nodes'\?\); CreatureOptions takes metres_"),
        ("egs.CreatureOptions(friction='high')", r"CreatureOptions: friction is 'high'; give a number$"),
        ("egs.make_creature('a.ply')", r"cloud is 'a\.ply'; give a GaussianCloud \(read_capture returns one\)$"),
        ("egs.prepare_scene('room.ply', (0, 0, 0.5))", r"^prepare_scene: cloud is 'room\.ply'; give a GaussianCloud"),
        ("egs.show(7)", r"^show: subject is 7; give a SimulatedRun \(simulate returns one\), a Creature \(make_crea"),
        ("egs.make_creature(None, nodes=1)", r"no argument nodes; pass options=CreatureOptions\(nodes=\.\.\.\)$"),
        ("egs.animate(None, 'out', nodes=1)", r"options=AnimateOptions\(creature=CreatureOptions\(nodes=\.\.\.\)\)$"),
        ("egs.read_capture(3)", r"^read_capture: path is 3; give a path or a text$"),
        ("egs.Camera.look_at([2, 0, 1], [0, 0, 0], [0, 0, 1], fov=3)", r"^Camera\.look_at: there is no argument fov"),
        ("egs.World().add(3)", r"^World\.add: body is 3; give a Creature \(make_creature returns one\) or a Prop \("),
        ("egs.Box([0, 0], [1, 1])", r"^Box: low is \[0, 0\]; give an array of numbers of shape \(3,\)$"),
        ("egs.SceneOptions(inpainter='telea')", r"give an Inpainter \(inpainter_by_name returns one\)$"),
        ("egs.FinetuneOptions(densification='none')", r"\(did you mean Densification\.NONE\?\)$"),
        ("egs.Job('jump', pushes=[1])", r"^Job: pushes\[0\] is 1; give a Push$"),
    ],
)
def test_wrong_public_calls_are_explained(call: str, message: str) -> None:
    with pytest.raises(TypeError, match=message):
        eval(call)


def test_public_functions_can_be_pickled() -> None:
    assert pickle.loads(pickle.dumps(egs.make_prop)) is egs.make_prop


def test_arrays_of_public_classes_may_be_lists() -> None:
    assert isinstance(egs.ObjectSpec(point=[0, 0, 0.5]).point, np.ndarray)  # pyright: ignore[reportArgumentType]
    assert egs.CreatureOptions(cage_file="cage.npz").cage_file == Path("cage.npz")  # pyright: ignore
