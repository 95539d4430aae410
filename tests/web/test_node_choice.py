"""Number of nodes of a live creature, which depends on the speed of the machine."""

from __future__ import annotations

import pytest

from egs_warp.web.node_choice import MAX_CHOSEN, MIN_CHOSEN, MachineSpeed, probe_seconds


@pytest.mark.parametrize(
    ("seconds", "nodes"),
    [
        (1e-5, MAX_CHOSEN),
        (1.5e-3, 290),
        (7.0e-3, MIN_CHOSEN),
        (0.1, MIN_CHOSEN),
    ],
)
def test_slower_machines_get_fewer_nodes_within_limits(seconds: float, nodes: int):
    assert MachineSpeed(seconds).nodes == nodes


@pytest.mark.parametrize(
    ("nodes", "probe", "step"),
    # Times of the probe and of a step on a busy Xeon, s, for 250 and 120 requested nodes.
    [(362, 7.8e-3, 0.160), (220, 7.0e-3, 0.097)],
)
def test_the_expected_speed_is_that_of_the_cage_not_of_the_request(nodes: int, probe: float, step: float):
    """A cage has more nodes than requested."""
    assert MachineSpeed(probe).speed(nodes) == pytest.approx(1.0 / (60.0 * step), rel=0.03)


def test_the_note_states_the_expected_speed():
    assert MachineSpeed(3e-3).speed_note(444) == "expect about 0.2 of real time"
    assert MachineSpeed(1e-5).speed_note(444) == "expect real time"


def test_the_speed_is_that_of_the_clock(monkeypatch: pytest.MonkeyPatch):
    now = [0.0]

    def tick() -> float:
        now[0] += 0.02
        return now[0]

    monkeypatch.setattr("egs_warp.web.node_choice.time.perf_counter", tick)
    # The clock is read once in each pass, and twice around all passes.
    assert probe_seconds() == pytest.approx(0.02, rel=0.2)
