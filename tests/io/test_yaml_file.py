"""Values in YAML files are read as in YAML 1.2."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from egs_warp.io.yaml_file import read_yaml


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
