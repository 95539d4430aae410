"""Plots of a run, which show its quantities."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from PIL import Image

from egs_warp.locomotion.ledger import energy_balance
from egs_warp.pipelines.plots import draw_plots
from tests.support.flights import rigid_flight
from tests.support.slides import slide, with_self_contact


def picture(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB"), dtype=float)


@pytest.mark.slow
def test_the_same_run_gives_the_same_bytes_and_another_another_picture(tmp_path: Path) -> None:
    t = slide().trajectory()
    books = energy_balance(t)
    planned = np.full((len(t.time), 3), np.nan)
    planned[3:9] = [0.1, 0.0, 0.9]
    runs = {
        "a": (t, books),
        "b": (t, books),
        "other": (
            replace(t, contact_force=2.0 * t.contact_force, activations=t.activations[:, ::-1], planned_com=planned),
            replace(books, damping=2.0 * books.damping, elastic=1.0 + books.elastic),
        ),
    }
    for name, run in runs.items():
        draw_plots(tmp_path / f"{name}.png", *run)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    changed = np.abs(picture(tmp_path / "other.png") - picture(tmp_path / "a.png")).max(axis=2) > 30.0
    high, wide = changed.shape[0] // 3, changed.shape[1] // 2
    # The panels are stored energies, flows, load, residual, centre of mass and muscles.
    for row, column in ((0, 0), (0, 1), (1, 0), (1, 1), (2, 0), (2, 1)):
        here = changed[row * high : (row + 1) * high, column * wide : (column + 1) * wide]
        assert here.sum() > 200, (row, column)


def test_ahead_is_the_front_of_the_body(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """If a body faces +y and flies along +x, the plot shows a displacement to its right."""
    drawn = {}
    plot = Axes.plot

    def recorded(axes: Axes, *values: Any, **options: Any) -> Any:
        drawn[options.get("label")] = values
        return plot(axes, *values, **options)

    monkeypatch.setattr(Axes, "plot", recorded)
    t = replace(rigid_flight(), front=np.array([0.0, 1.0, 0.0]))
    draw_plots(tmp_path / "plots.png", t, energy_balance(t))
    com = t.node_mass @ t.positions[-1] / t.node_mass.sum() - t.node_mass @ t.positions[0] / t.node_mass.sum()
    assert abs(com[0]) > 0.1 * t.height
    for label, expected in (("up", com[2]), ("ahead", com[1]), ("left", -com[0])):
        assert drawn[label][1][-1] == pytest.approx(expected / t.height, abs=1e-9), label


def test_self_contact_is_no_load_on_the_ground(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    drawn: list[dict[str, np.ndarray]] = []
    stairs = Axes.stairs

    def record(axes: Axes, load: np.ndarray, edges: np.ndarray, *, label: str, **options: Any) -> object:
        drawn[-1][label] = load
        return stairs(axes, load, edges, label=label, **options)

    monkeypatch.setattr(Axes, "stairs", record)
    for t in (slide().trajectory(), with_self_contact(slide().trajectory())):
        drawn.append({})
        draw_plots(tmp_path / "plots.png", t, energy_balance(t))
    for label in ("normal", "friction"):
        assert drawn[0][label].max() > 0.1
        np.testing.assert_array_equal(drawn[1][label], drawn[0][label])


def test_a_flight_without_contact_or_pull_is_drawn(tmp_path: Path) -> None:
    t = rigid_flight()
    draw_plots(tmp_path / "plots.png", t, energy_balance(t))
    assert picture(tmp_path / "plots.png").std() > 10.0
