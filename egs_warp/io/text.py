"""Reading of small files written by users, with one-line error messages."""

from __future__ import annotations

import codecs
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from egs_warp.errors import UserError
from egs_warp.io.limits import MAX_TEXT_BYTES, read_bytes

_EXACT_DIGITS = 15
"""Maximum number of digits at which every integer is exact as a float."""
MAX_NESTING = 100
"""Maximum depth of nested lists and objects in a file."""
_MAX_EXCERPT = 60
"""Maximum number of characters of an invalid value in a message."""
_STRING_OR_BRACKET = re.compile(r'"[^"\\]*(?:\\.[^"\\]*)*"?|[\[\]{}]', re.DOTALL)
"""Pattern of a JSON string, which may be cut off, or of a bracket outside strings."""


def read_text(path: Path | str) -> str:
    """Read the text of a file. Raises ``UserError`` if it cannot be read or decoded."""
    return decode_text(read_bytes(path, at_most=MAX_TEXT_BYTES), path)


def decode_text(data: bytes, path: Path | str) -> str:
    """Decode UTF-8 or, after its byte order mark, UTF-16. Raises ``UserError`` for other bytes."""
    try:
        if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            return data.decode("utf-16")
        return data.removeprefix(codecs.BOM_UTF8).decode()
    except UnicodeDecodeError:
        raise UserError(f"{path}: not a text file (UTF-8); save it as UTF-8") from None


def decimal_number(word: str) -> float:
    """Parse a number whose decimal separator is a point or a comma. Raises ``ValueError`` for other words."""
    try:
        return float(word)
    except ValueError:
        if word.count(",") != 1 or "." in word:
            raise
        return float(word.replace(",", "."))


def whole_number(digits: str) -> int | float:
    """Parse an integer. An integer with more than ``_EXACT_DIGITS`` digits becomes a float, possibly infinite, which is
    outside every valid range."""
    return int(digits) if len(digits) <= _EXACT_DIGITS else float(digits)


def load_json(
    text: str | bytes,
    *,
    parse_int: Callable[[str], Any] | None = None,
    parse_constant: Callable[[str], Any] | None = None,
) -> Any:
    """Parse JSON whose lists and objects are nested at most ``MAX_NESTING`` deep.

    Deeper texts could reach Python's recursion limit, and if the garbage collector runs there, finalizers fail and
    their arrays are never freed.

    Args:
        text: JSON in Unicode, or in bytes of UTF-8, UTF-16 or UTF-32.
        parse_int: function that converts the digits of an integer.
        parse_constant: function that converts ``NaN`` and ``Infinity``.

    Raises:
        ValueError: the text is not JSON (``json.JSONDecodeError``), or it is nested too deeply.
    """
    if isinstance(text, bytes):
        text = text.decode(json.detect_encoding(text), "surrogatepass")
    depth = 0
    for token in _STRING_OR_BRACKET.finditer(text):
        bracket = token[0]
        depth += 1 if bracket in "[{" else -1 if bracket in "]}" else 0
        if depth > MAX_NESTING:
            raise ValueError(f"lists and objects are nested more than {MAX_NESTING} deep")
    return json.loads(text, parse_int=parse_int, parse_constant=parse_constant)


def parse_json(text: str, path: Path | str) -> Any:
    """Parse the ``text`` of ``path``. Raises ``UserError`` if it is not JSON."""
    try:
        return load_json(text, parse_int=whole_number)
    except json.JSONDecodeError as error:
        raise UserError(f"{path}: not JSON at line {error.lineno} ({error.msg}); correct that line") from None
    except ValueError:
        raise UserError(f"{path}: its lists are nested too deeply; write fewer levels") from None


def json_excerpt(value: Any) -> str:
    """Return a value of a JSON file as text for a message, cut to ``_MAX_EXCERPT`` characters."""
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= _MAX_EXCERPT else f"{text[:_MAX_EXCERPT]} ..."
