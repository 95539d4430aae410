"""Small files that users write by hand, read with one line for whatever is wrong."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from egs_warp.errors import UserError
from egs_warp.io.limits import LARGEST_TEXT, read_bytes

_EXACT_DIGITS = 15
"""Whole numbers of so many digits are exact as floats, too."""


def read_text(path: Path | str) -> str:
    """The text of a file. Raises ``UserError`` where there is none."""
    try:
        return read_bytes(path, at_most=LARGEST_TEXT).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise UserError(f"{path}: not a text file (UTF-8)") from None


def whole_number(digits: str) -> int | float:
    """The number that ``digits`` write; one of many digits as a float, infinite if need be,
    which every check of a range refuses.
    """
    return int(digits) if len(digits) <= _EXACT_DIGITS else float(digits)


def parse_json(text: str, path: Path | str) -> Any:
    """What the ``text`` of ``path`` holds. Raises ``UserError`` where it is not JSON."""
    try:
        return json.loads(text, parse_int=whole_number)
    except json.JSONDecodeError as error:
        raise UserError(f"{path}: not JSON at line {error.lineno} ({error.msg}); correct that line") from None
    except RecursionError:
        raise UserError(f"{path}: lists in lists in lists, too deep to read") from None
