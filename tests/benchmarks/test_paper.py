"""``make paper``: every stage runs with the given flags, failures are reported, aims are collected."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import pytest

from tests.support.scripts import BENCHMARKS, module_of

SCRIPT = """
import argparse, json, sys
from pathlib import Path
parser = argparse.ArgumentParser()
for flag in ("--seed", "--json", "--plot", "--device"):
    parser.add_argument(flag)
parser.add_argument("--quick", action="store_true")
asked = parser.parse_args()
print("asked:", asked.device, asked.quick)
if asked.seed == "13":
    sys.exit("unlucky")
why = {"fast": "no GPU"}
Path(asked.json).write_text(json.dumps({"aims": {"right": True, "fast": None}, "why_null": why}))
"""


@pytest.fixture
def paper(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    """Return the module ``paper`` with two stages that end at once."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    module = module_of("paper")
    (tmp_path / "script.py").write_text(SCRIPT)
    monkeypatch.setattr(module, "ROOT", tmp_path)
    stages = (module.Stage("one", "Table 1", "script.py"), module.Stage("two", "Table 2", "script.py", device="cuda:3"))
    monkeypatch.setattr(module, "STAGES", stages)
    return module


def test_every_script_of_the_paper_exists(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    module = module_of("paper")
    assert {stage.name for stage in module.STAGES} >= {"table1", "table2", "table3", "figure7", "figure8", "inpaint"}
    for stage in module.STAGES:
        assert (module.ROOT / stage.script).is_file()


def test_stages_run_with_their_flags_and_their_targets_are_collected(
    paper: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    asked = ["--quick", "--device", "cpu", "--out", str(out), "--json", str(tmp_path / "all.json")]
    assert paper.main(asked) == 0
    assert (out / "one.txt").read_text() == "asked: cpu True\n"
    assert (out / "two.txt").read_text() == "asked: cuda:3 True\n"
    told = capsys.readouterr().out
    assert "[1/2] Table 1 ..." in told and "[2/2] Table 2: " in told
    result = json.loads((tmp_path / "all.json").read_text())
    assert result["aims"] == {"one.right": True, "one.fast": None, "two.right": True, "two.fast": None}
    assert result["why_null"] == {"one.fast": "no GPU", "two.fast": "no GPU"}
    assert "| `one.fast` | not judged | no GPU |" in (out / "paper.md").read_text()


def test_a_stage_that_fails_is_reported_and_the_others_run(
    paper: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert paper.main(["--out", str(tmp_path), "--device", "cpu"]) == 0
    assert paper.main(["--out", str(tmp_path), "--device", "cpu", "--only", "two", "--keep"]) == 0
    assert "Table 2: skipped" in capsys.readouterr().out
    assert paper.main(["--out", str(tmp_path), "--device", "cpu", "--seed", "13"]) == 2
    assert f"failed: unlucky ({tmp_path / 'one.txt'})" in capsys.readouterr().out
    assert "failed with 1" in (tmp_path / "paper.md").read_text()
