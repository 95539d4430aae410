"""Coulomb coefficients of pairs of materials: tables that are accepted, and the coefficient of two bodies."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from egs_warp.errors import ArgumentError
from egs_warp.pipelines.friction_table import FrictionTable
from egs_warp.pipelines.world import World

_KEY = 'give a pair of materials as the key, such as ("ice", "rubber")'
_NUMBER = "give a Coulomb coefficient from 0 to 10"


@pytest.mark.parametrize(
    ("key", "friction", "message"),
    [
        ("ab", 0.1, f"'ab': {_KEY}"),
        ("ice", 0.1, f"'ice': {_KEY}"),
        (("a",), 0.1, f"('a',): {_KEY}"),
        (("a", 2), 0.1, f"('a', 2): {_KEY}"),
        (("a", ""), 0.1, f"('a', ''): {_KEY}"),
        (("b", "a"), "x", f"a and b: 'x': {_NUMBER}"),
        (("a", "b"), True, f"a and b: True: {_NUMBER}"),
        (("a", "b"), None, f"a and b: None: {_NUMBER}"),
        (("a", "b"), -0.1, f"a and b: -0.1: {_NUMBER}"),
        (("a", "b"), 10.5, f"a and b: 10.5: {_NUMBER}"),
        (("a", "b"), float("nan"), f"a and b: nan: {_NUMBER}"),
        (("ground", "ground"), 0.1, "ground and ground: the ground does not move; give the material of a body"),
    ],
)
def test_wrong_entries_are_refused(key: Any, friction: Any, message: str) -> None:
    with pytest.raises(ArgumentError, match=f"^{re.escape(f'frictions {message}')}$"):
        World(frictions={key: friction})


def test_a_pair_is_given_once_in_either_order() -> None:
    with pytest.raises(ArgumentError, match=r"^frictions a and b: the pair is given twice; give it once$"):
        World(frictions={("a", "b"): 0.1, ("b", "a"): 0.1})
    table = FrictionTable.of([(("rubber", "ice"), 0), (("ice", "ground"), np.float32(10.0))])
    assert table.between("ice", "rubber") == table.between("rubber", "ice") == 0.0
    assert table.between("ground", "ice") == 10.0
    assert table.between("rubber", "ground") is None and table.between("ice", None) is None
    assert table.materials == ["ice", "rubber"]


def test_bodies_without_an_entry_have_the_geometric_mean_of_their_coefficients() -> None:
    """The diagonal is the coefficient of a body with itself, for self contact. A body without a material has no
    entry."""
    table = FrictionTable.of([(("ice", "ice"), 0.02), (("ice", "rubber"), 0.1)])
    result = table.matrix(["ice", "rubber", None, "ice"], [0.5, 0.9, 0.4, 0.8])
    mixed = np.sqrt(0.9 * 0.4)
    np.testing.assert_allclose(
        result,
        [
            [0.02, 0.1, np.sqrt(0.5 * 0.4), 0.02],
            [0.1, 0.9, mixed, 0.1],
            [np.sqrt(0.5 * 0.4), mixed, 0.4, np.sqrt(0.4 * 0.8)],
            [0.02, 0.1, np.sqrt(0.4 * 0.8), 0.02],
        ],
    )


def test_a_note_names_the_materials_without_bodies() -> None:
    table = FrictionTable.of([(("ice", "ground"), 0.1), (("rubber", "rubber"), 0.9), (("rubber", "steel"), 0.4)])
    unused = [f"no body has the material {each!r}, so its frictions are not used" for each in ("ice", "steel")]
    lone = "only one body has the material 'rubber', so its friction with itself is not used"
    assert table.unused_notes([("rubber", False), (None, False)]) == (*unused, lone)
    assert table.unused_notes([("rubber", True)]) == tuple(unused)
    assert table.unused_notes([("rubber", False), ("rubber", False), ("ice", False), ("steel", False)]) == ()
