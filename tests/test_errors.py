"""Error messages, which name arguments in the library and flags in the commands."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from egs_warp.commands.exit_handling import one_line_errors
from egs_warp.commands.flags import flag_of
from egs_warp.errors import ArgumentError, UserError, did_you_mean

PACKAGE = Path(__file__).parents[1] / "egs_warp"
FLAG = re.compile(r"(?<![\w-])--[a-z]")


def test_an_argument_is_called_by_its_name_or_by_its_flag() -> None:
    error = ArgumentError("metres_per_unit", "give a positive number", value=-2.0)
    assert str(error) == "metres_per_unit -2.0: give a positive number"
    assert error.format_message(flag_of) == "--metres-per-unit -2.0: give a positive number"
    error = ArgumentError("solids", "the body is inside solid 2", check=("plane", "muscles_file"))
    assert str(error) == "solids: the body is inside solid 2; check plane and muscles_file"
    assert error.format_message(flag_of) == "--terrain: the body is inside solid 2; check --plane and --muscles"
    assert UserError("object: it is flat", check=("up",)).format_message(flag_of) == "object: it is flat; check --up"


def test_a_line_stays_one_line() -> None:
    error = ArgumentError("motion", "a\nb" + 3000 * "c", value="\x1b[1m")
    assert str(error).startswith("motion \\x1b[1m: a\\nbccc") and len(str(error)) < 2010


def test_the_beginning_of_a_name_suggests_the_first_such_name() -> None:
    names = ["stand", "land and pose", "land on", "walk"]
    assert did_you_mean("Land", names) == " (did you mean 'land and pose'?)"
    assert did_you_mean("la", names) == "" and did_you_mean("wlak", names) == " (did you mean 'walk'?)"


def test_a_program_ends_with_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end, one_line_errors("jump.py"):
        raise ArgumentError("size", "give a number of pixels", value=0)
    assert end.value.code == 2 and capsys.readouterr().err == "jump.py: --size 0: give a number of pixels\n"


def test_only_commands_mention_flags() -> None:
    """No string of the library contains ``--flag``, except docstrings."""
    for path in sorted(PACKAGE.rglob("*.py")):
        if path.is_relative_to(PACKAGE / "commands") or path.name == "cli.py":
            continue
        tree = ast.parse(path.read_text())
        bare = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in bare:
                assert not FLAG.search(node.value), f"{path.name}:{node.lineno}: {node.value}"
