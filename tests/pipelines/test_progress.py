"""Progress bars with stages and remaining time, which are redrawn while a stage reports nothing."""

from __future__ import annotations

import io
import time
from collections.abc import Mapping
from functools import partial

import numpy as np
import pytest

from egs_warp.geometry.plane import Plane
from egs_warp.inpainting.holes import Hole
from egs_warp.inpainting.rectified import PlaneWindow
from egs_warp.pipelines.prepare_scene import SceneOptions
from egs_warp.pipelines.progress import (
    conversion_bar,
    info_bar,
    photos_bar,
    preparation_bar,
    render_bar,
    scene_bar,
    simulation_bar,
)
from egs_warp.segmentation.clearance import StraddlingPolicy


class Terminal(io.StringIO):
    """Text stream that claims to be a terminal."""

    def isatty(self) -> bool:
        return True


def drawn(
    costs: Mapping[str, float], monkeypatch: pytest.MonkeyPatch, told: list[tuple[float, str, float]]
) -> list[str]:
    """Return the displayed line after each of ``told``: seconds since the start, stage, completed fraction."""
    clock = [1000.0]
    monkeypatch.setattr("tqdm.std.time", lambda: clock[0])
    file, lines = Terminal(), []
    with scene_bar(costs, file=file) as bar:
        for seconds, stage, done in told:
            clock[0] = 1000.0 + seconds
            bar.update(stage, done)
            lines.append(file.getvalue().split("\r")[-1].strip())
    assert file.getvalue().split("\r")[-1].startswith("scene: done, ")
    return lines


def test_a_scene_shows_its_stages_and_the_remaining_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """The remaining time follows from the expected costs of the stages, and from the speed of the current stage after
    its first report, because the time before that may include an import."""
    costs = {"plane": 12.0, "ground": 15.0, "segment": 48.0, "inpaint": 25.0}
    told = [
        (0.0, "plane", 0.0),
        (12.0, "ground", 0.0),
        (27.0, "segment", 0.0),
        (47.0, "segment", 0.1),
        (50.0, "segment", 0.2),
        (59.0, "segment", 0.5),
    ]
    assert drawn(costs, monkeypatch, told) == [
        "scene: plane, 00:00<?",
        "scene: ground, 00:12<01:28",
        "scene: segment, 00:27<01:13",
        "scene: segment, 00:47<00:53",
        "scene: segment, 00:50<00:48",
        "scene: segment, 00:59<00:39",
    ]


def test_a_log_contains_each_stage_once() -> None:
    file = io.StringIO()
    with scene_bar({"plane": 1.0, "segment": 1.0}, file=file) as bar:
        for stage, done in (("plane", 0.0), ("segment", 0.0), ("segment", 0.3), ("segment", 0.6)):
            bar.update(stage, done)
    pieces = [piece.split(",")[0].strip() for piece in file.getvalue().split("\r")]
    assert [piece for piece in pieces if piece] == ["scene: plane", "scene: segment", "scene: done", "scene: done"]


def test_better_costs_replace_the_expected_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Once the object and the hole are known, the inpainting is expected to take half as long."""
    clock, file = [1000.0], io.StringIO()
    monkeypatch.setattr("tqdm.std.time", lambda: clock[0])
    with scene_bar({"plane": 10.0, "segment": 10.0, "inpaint": 40.0}, file=file) as bar:
        bar.update("plane")
        clock[0] += 10.0
        bar.expect({"plane": 10.0, "segment": 10.0, "inpaint": 20.0})
        bar.update("segment")
        assert file.getvalue().split("\r")[-1].strip() == "scene: segment, 00:10<00:30"


def test_skipped_stages_are_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """If the ground, training and inpainting are skipped, little time remains after the stage of the plane."""
    options = SceneOptions(clearing=StraddlingPolicy.SPLIT, flat=True, inpaint=False)
    costs = options.costs(50_000)
    assert list(costs) == ["plane", "segment"]
    assert costs["segment"] < costs["plane"]


def test_the_costs_of_a_scene_follow_its_sizes() -> None:
    """The cost of training at the plane increases with the size of the object. The cost of inpainting does not depend
    on the size of the hole in scene units."""
    options = SceneOptions(clearing=StraddlingPolicy.FINETUNE)
    few, many = (options.costs(50_000, object_count=count) for count in (10_000, 40_000))
    assert many["segment"] > few["segment"] + 0.5
    rows, columns = np.indices((40, 40)) - 20
    square = np.maximum(abs(rows), abs(columns)) < 15
    floor = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
    small, large = (Hole(PlaneWindow(floor, np.zeros(3), texel, 40, 40), square) for texel in (0.01, 1.0))
    costs = [options.costs(50_000, hole=hole)["inpaint"] for hole in (small, large)]
    assert costs[0] == pytest.approx(costs[1])
    assert options.costs(50_000)["inpaint"] == pytest.approx(costs[0], rel=0.5)


def test_stages_show_the_remaining_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each stage starts at its typical fraction of the total time, from which the remaining time follows."""
    clock = [1000.0]
    monkeypatch.setattr("tqdm.std.time", lambda: clock[0])
    for bar, name, told in (
        (partial(conversion_bar, "a.SPZ"), "convert", {"write": (0.0, "?"), "compare": (6.5, "00:03")}),
        (info_bar, "look", {"cage": (0.0, "?"), "front": (7.0, "00:03"), "muscles": (9.1, "00:00")}),
        (partial(info_bar, checks_balance=True), "look", {"cage": (0.0, "?"), "balance": (6.6, "00:13")}),
        (preparation_bar, "prepare", {"cage": (0.0, "?"), "front": (45.0, "00:55"), "stand": (80.0, "00:14")}),
    ):
        file = io.StringIO()
        clock[0] = 1000.0
        with bar(file=file) as begins:
            for stage, (seconds, left) in told.items():
                clock[0] = 1000.0 + seconds
                begins(stage)
                line = file.getvalue().split("\r")[-1].strip()
                assert line == f"{name}: {stage}, {int(seconds) // 60:02}:{int(seconds) % 60:02}<{left}"
        assert file.getvalue().split("\r")[-1].startswith(f"{name}: done, ")


def test_the_times_move_while_a_stage_reports_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The bar redraws itself. A stage that takes five times its expected time still has a remaining time."""
    clock = [1000.0]
    monkeypatch.setattr("tqdm.std.time", lambda: clock[0])
    monkeypatch.setattr("egs_warp.pipelines.progress._REFRESH_INTERVAL", 0.01)
    file = Terminal()
    with preparation_bar(file=file) as begins:
        for stage, seconds in (("cage", 0.0), ("body and muscles", 68.0), ("stand", 85.0)):
            clock[0] = 1000.0 + seconds
            begins(stage)
        for seconds, line in ((87.0, "01:27<00:13"), (95.0, "01:35<00:08"), (135.0, "02:15<00:22")):
            clock[0] = 1000.0 + seconds
            deadline = time.monotonic() + 5.0
            while f"prepare: stand, {line}" not in file.getvalue():
                assert time.monotonic() < deadline, file.getvalue().split("\r")[-1]
                time.sleep(0.01)


def test_a_simulation_is_redrawn_while_a_frame_takes_long(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [1000.0]
    monkeypatch.setattr("tqdm.std.time", lambda: clock[0])
    monkeypatch.setattr("egs_warp.pipelines.progress._REFRESH_INTERVAL", 0.01)
    file = Terminal()
    with simulation_bar(file=file) as update:
        update(2, 10)
        clock[0] = 1130.0
        deadline = time.monotonic() + 5.0
        while "02:10<" not in file.getvalue():
            assert time.monotonic() < deadline, file.getvalue().split("\r")[-1]
            time.sleep(0.01)


def test_a_quiet_bar_writes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    file = io.StringIO()
    with preparation_bar(quiet=True, file=file) as begins:
        begins("cage")
    # A program without a console has no standard error output.
    monkeypatch.setattr("sys.stderr", None)
    with preparation_bar(quiet=True) as begins:
        begins("cage")
    with pytest.raises(KeyboardInterrupt), preparation_bar(file=file):
        raise KeyboardInterrupt
    assert file.getvalue() == ""


def test_all_stages_from_photos_to_a_film_share_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = [1000.0]
    monkeypatch.setattr("tqdm.std.time", lambda: clock[0])
    file, lines = io.StringIO(), []

    def shown() -> None:
        lines.append(file.getvalue().split("\r")[-1].strip())

    with photos_bar(["pose", "train", "scene", "prepare", "simulate", "render"], file=file) as bar:
        bar.update("pose")
        bar.skip("pose")
        bar.update("train")
        clock[0] += 100.0
        with scene_bar({"plane": 12.0, "segment": 49.0}) as scene:
            scene.update("plane")
            shown()
            scene.update("segment")
        with preparation_bar() as begin_stage:
            begin_stage("stand")
            begin_stage("balance")
        with simulation_bar() as progress:
            progress(1, 2)
            shown()
        with render_bar(2) as show_image:
            show_image()
            shown()
    # The training took 100 s. The expected time of the scene is 3/10 of that of the training, so 30 s are estimated for
    # it, and 28 s for the rest.
    assert [line.split(",")[0] for line in lines] == [f"photos to film: {s}" for s in ("scene", "simulate", "render")]
    assert lines[0].endswith(", 01:40<00:58")
    assert file.getvalue().split("\r")[-1].startswith("photos to film: done, 01:40")
    assert capsys.readouterr().err == ""
