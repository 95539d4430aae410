"""Harness of the benchmarks: every script accepts the common flags and writes a table, JSON and an image."""

from __future__ import annotations

import json
import time
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from PIL import Image

from tests.support.scripts import BENCHMARKS, module_of

SCRIPTS = sorted(path.stem for path in BENCHMARKS.glob("*.py") if "\ndef main(" in path.read_text())
"""Names of the benchmark scripts; the other modules of the folder have no ``main``."""


@pytest.fixture
def harness() -> ModuleType:
    return module_of("harness")


@pytest.mark.parametrize("name", SCRIPTS)
def test_every_benchmark_takes_the_flags(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The script can be imported, and ``--help`` prints the common flags and the script's docstring."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    script = module_of(name)
    with pytest.raises(SystemExit) as end:
        script.main(["--help"])
    told = capsys.readouterr().out
    assert end.value.code == 0
    assert script.__doc__ is not None and script.__doc__.splitlines()[0] in told
    for flag in ("--quick", "--device", "--seed", "--json", "--plot"):
        assert flag in told, flag


def test_there_are_benchmarks() -> None:
    """The scripts are found by their ``main``. Their number is checked, because a script without ``main`` would be left
    out of the test above."""
    assert len(SCRIPTS) == 39


def test_benchmark_outputs(harness: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The harness prints a table with a header and writes a JSON file and an image."""
    files = {"json": tmp_path / "figures.json", "plot": tmp_path / "picture.png"}
    asked = ["--quick", "--seed", "3", "--json", str(files["json"]), "--plot", str(files["plot"])]
    options = harness.flags("What.", quick="less", device="cpu").parse_args(asked)
    table = harness.Table(name="<6", mean_ms="7.2f", share=".0%")
    table.row("slow", 12.3456, 0.25)
    table.row("none", None, 1.0)
    harness.report(
        options,
        [{"name": "slow", "mean": 12.3456}],
        extra=[1, 2],
        aims={"fast": np.bool_(False), "on_gpu": None},
        why_null={"on_gpu": "no GPU here"},
        conditions={"frames": 7},
        draw=lambda figure: figure.subplots().plot([0.0, 1.0]),
        size=(2.0, 1.0),
    )
    told = capsys.readouterr().out.splitlines()
    assert told[:3] == ["name    mean ms  share", "slow      12.35    25%", "none          -   100%"]
    assert json.loads("\n".join(told[3:])) == {
        "aims": {"fast": False, "on_gpu": None},
        "why_null": {"on_gpu": "no GPU here"},
    }
    result = json.loads(files["json"].read_text())
    assert list(result) == ["rows", "extra", "environment", "aims", "why_null"]
    assert result["rows"] == [{"name": "slow", "mean": 12.3456}] and result["extra"] == [1, 2]
    assert result["aims"] == {"fast": False, "on_gpu": None}
    there = result["environment"]
    assert (there["device"], there["seed"], there["quick"], there["frames"]) == ("cpu", 3, True, 7)
    assert there["threads"] >= 1 and {"device_name", "python", "warp-lang", "egs-warp"} <= set(there)
    with Image.open(files["plot"]) as picture:
        assert picture.size == (240, 120)


def test_picture_of_floats(harness: ModuleType, tmp_path: Path) -> None:
    """Pixel values are floats, which are clipped to the range from 0 to 1, rounded and written as bytes."""
    options = harness.flags("What.", quick="less", device="cpu").parse_args(["--plot", str(tmp_path / "p.png")])
    harness.report(options, [], aims={}, picture=np.full((2, 2, 3), [0.5, 1.7, -1.0]))
    with Image.open(tmp_path / "p.png") as picture:
        assert picture.getpixel((0, 0)) == (128, 255, 0)


def test_an_aim_is_judged_or_explained(harness: ModuleType) -> None:
    options = harness.flags("What.", quick="less", device="cpu").parse_args([])
    with pytest.raises(ValueError, match="aims without a value need a reason in why_null: fast"):
        harness.record(options, [], aims={"fast": None})


def test_data_folder(harness: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    """The environment variable sets the data folder, which by default is next to the repository."""
    monkeypatch.setenv("EGS_WARP_DATA", "/elsewhere")
    assert harness.data_folder() == Path("/elsewhere")
    monkeypatch.delenv("EGS_WARP_DATA")
    assert harness.data_folder() == BENCHMARKS.parents[1] / "shared" / "data"


def test_calls_take_turns(harness: ModuleType) -> None:
    """Calls alternate; the median is taken over all calls except those for warming up."""
    order: list[str] = []
    naps = iter([0.5, 0.0, 0.02, 0.02, 0.02])

    def slow() -> None:
        order.append("slow")
        time.sleep(next(naps))

    medians = harness.median_ms({"slow": slow, "fast": lambda: order.append("fast")}, repeats=3, warm_up=2)
    assert order == ["slow", "fast"] * 5
    assert 20.0 <= medians["slow"] < 400.0
    assert medians["fast"] < medians["slow"]


def test_timed(harness: ModuleType) -> None:
    result, milliseconds = harness.timed(sorted, [3, 1, 2], reverse=True)
    assert result == [3, 2, 1] and 0.0 <= milliseconds < 1e3
