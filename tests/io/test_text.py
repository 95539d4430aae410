"""JSON of any nesting is parsed or refused without coming near Python's recursion limit."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from egs_warp.errors import UserError
from egs_warp.io.text import MAX_NESTING, json_excerpt, load_json, parse_json
from egs_warp.io.yaml_file import read_yaml


@pytest.mark.parametrize("opening, closing", ["[]", ('{"a":', "}")])
def test_nesting_is_limited(opening: str, closing: str) -> None:
    whole = opening * MAX_NESTING + "1" + closing * MAX_NESTING
    assert load_json(whole) == json.loads(whole)
    for deep in (opening + whole + closing, opening * 30_000):
        with pytest.raises(ValueError, match="nested more than 100 deep"):
            load_json(deep)
        with pytest.raises(UserError, match="its lists are nested too deeply; write fewer levels"):
            parse_json(deep, "a.json")


def test_brackets_in_strings_do_not_nest() -> None:
    tree = {"[" * 200: ["\\" + "[" * 200, '"' + "{" * 200, '\\"']}
    for encoding in ("utf-8", "utf-16", "utf-32"):
        assert load_json(json.dumps(tree).encode(encoding)) == tree
    with pytest.raises(json.JSONDecodeError):
        load_json('["' + "[" * 200)


@pytest.mark.parametrize("depth", [MAX_NESTING - 1, MAX_NESTING, 5000])
def test_nesting_of_yaml_is_limited(depth: int, tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("[" * depth + "1" + "]" * depth)
    if depth < MAX_NESTING:
        values, _ = read_yaml(path)
        assert str(values) == path.read_text()
    else:
        with pytest.raises(UserError, match="nested too deeply; write fewer levels"):
            read_yaml(path)


def test_an_excerpt_of_a_long_value_is_short() -> None:
    assert json_excerpt({"a": [1, "ü"]}) == '{"a": [1, "ü"]}'
    assert json_excerpt(list(range(1000))) == f"{json.dumps(list(range(1000)))[:60]} ..."
