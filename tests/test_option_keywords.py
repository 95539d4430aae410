"""``egs_warp.option_keywords``."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

import egs_warp as egs
from egs_warp.option_keywords import takes_options


@dataclass(frozen=True)
class Inner:
    nodes: int = 500
    size: int = 1


@dataclass(frozen=True)
class Outer:
    size: int = 2
    inner: Inner = field(default_factory=Inner)


@takes_options(options=Outer)
def make(thing: str, *, plane: int | None = None, options: Outer | None = None) -> tuple[str, int | None, Outer | None]:
    return thing, plane, options


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"nodes": 3}, "make: nodes is a field of Inner; pass options=Outer(inner=Inner(nodes=...))"),
        ({"size": 3}, "make: size is a field of Outer; pass options=Outer(size=...)"),
        ({"plan": 3}, "make: there is no argument plan (did you mean 'plane'?)"),
        ({"options": {"size": 3}}, "make: options is dict; pass options=Outer(...)"),
        ({"options": Outer}, "make: options is Outer; pass options=Outer(...)"),
    ],
)
def test_a_misplaced_option_is_named_with_its_dataclass(keywords: dict[str, object], message: str) -> None:
    with pytest.raises(TypeError) as error:
        make("thing", **keywords)  # pyright: ignore[reportArgumentType]
    assert str(error.value) == message


def test_valid_calls_pass_through() -> None:
    assert make("thing", plane=1, options=Outer(size=7)) == ("thing", 1, Outer(size=7))
    assert make("thing") == ("thing", None, None)


def test_the_public_functions_name_their_options() -> None:
    cloud = egs.scene("pawn").object
    with pytest.raises(TypeError, match=r"^make_creature: nodes is a field of CreatureOptions; pass options=Cre"):
        egs.make_creature(cloud, nodes=175)  # pyright: ignore[reportCallIssue]
    with pytest.raises(TypeError, match=r"pass options=AnimateOptions\(creature=CreatureOptions\(nodes=\.\.\.\)\)$"):
        egs.animate(cloud, "out", nodes=175)  # pyright: ignore[reportCallIssue]
