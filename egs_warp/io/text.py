"""Small files written by users, read with one-line error messages."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from egs_warp.errors import UserError
from egs_warp.io.limits import MAX_TEXT_BYTES, read_bytes

_EXACT_DIGITS = 15
"""Integers of this many digits are exact as floats, too."""


def read_text(path: Path | str) -> str:
    """Read the text of a file. Raises ``UserError`` if there is none."""
    try:
        return read_bytes(path, at_most=MAX_TEXT_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise UserError(f"{path}: not a text file (UTF-8); save it as UTF-8") from None


def whole_number(digits: str) -> int | float:
    """Parse ``digits``. Numbers of many digits become floats, possibly infinite, which every range check rejects."""
    return int(digits) if len(digits) <= _EXACT_DIGITS else float(digits)


def parse_json(text: str, path: Path | str) -> Any:
    """Parse the ``text`` of ``path``. Raises ``UserError`` if it is not JSON."""
    try:
        return json.loads(text, parse_int=whole_number)
    except json.JSONDecodeError as error:
        raise UserError(f"{path}: not JSON at line {error.lineno} ({error.msg}); correct that line") from None
    except RecursionError:
        raise UserError(f"{path}: its lists are nested too deeply; write fewer levels") from None
