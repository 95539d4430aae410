"""Decimal numbers in YAML files are read as in YAML 1.2, and written values are read back unchanged."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from egs_warp.io.yaml_file import read_yaml, yaml_text


@pytest.mark.parametrize(
    ("text", "value"),
    [
        *[("1e-3", 0.001), ("1.5E3", 1500.0), ("2.", 2.0), (".5", 0.5), ("-.5e+1", -5.0), ("+90", 90), ("-0", 0)],
        *[("007", "007"), ("1:30", "1:30"), ("1_0", "1_0"), ("0x10", "0x10"), ("2024-01-01", "2024-01-01")],
        *[(".nan", ".nan"), (".inf", ".inf"), ("1.2.3", "1.2.3"), ("e5", "e5"), ("-y", "-y"), ("0,5", "0,5")],
        *[("yes", True), ("~", None), ("", None), ("'1'", "1"), ("1" * 20, int("1" * 20))],
    ],
)
def test_values(text: str, value: Any, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(f"key: {text}\n")
    read = read_yaml(tmp_path / "a.yaml")[0]["key"]
    assert read == value and type(read) is type(value)


def test_written_values_are_read_back(tmp_path: Path) -> None:
    strings = ["1e5", "045", "1:30", "0x10", "-1.", "yes", "~", "1e400", "+1,2@1e5", ""]
    values = {"strings": strings, "view": "1e5", "numbers": [1e-5, 1e22, -2.5, 7], "switch": True}
    (tmp_path / "a.yaml").write_text(yaml_text(values))
    assert read_yaml(tmp_path / "a.yaml")[0] == values
