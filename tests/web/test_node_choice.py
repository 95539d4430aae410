"""Number of nodes of a live creature, which depends on the speed of the machine."""

from __future__ import annotations

import pytest

from egs_warp.web.node_choice import MAX_CHOSEN, MIN_CHOSEN, MachineSpeed, probe_seconds


@pytest.mark.parametrize(
    ("seconds", "nodes", "speed"),
    [
        (1e-5, MAX_CHOSEN, 1.0),
        (1.5e-3, 290, 0.5),
        # The measured steps took 97 ms with 120 nodes.
        (7.0e-3, MIN_CHOSEN, 0.172),
        (0.1, MIN_CHOSEN, 0.012),
    ],
)
def test_slower_machines_get_fewer_nodes_within_limits(seconds: float, nodes: int, speed: float):
    machine = MachineSpeed(seconds)
    assert machine.nodes == nodes
    assert machine.speed(nodes) == pytest.approx(speed, rel=0.05)
    assert f"about {nodes} nodes" in machine.choice()


def test_the_expected_speed_is_that_of_the_body_not_of_the_request():
    """A cage with thin parts has more nodes than requested; the time of a step grows with them."""
    machine = MachineSpeed(3e-3)
    assert machine.speed(444) == pytest.approx(machine.speed(250) * (250 / 444) ** 0.54)
    assert machine.revision(444) == "the body has 444 nodes; expect about 0.2 of real time"
    assert MachineSpeed(1e-5).revision(444) == "the body has 444 nodes; expect real time"


def test_the_speed_is_that_of_the_clock(monkeypatch: pytest.MonkeyPatch):
    now = [0.0]

    def tick() -> float:
        now[0] += 0.02
        return now[0]

    monkeypatch.setattr("egs_warp.web.node_choice.time.perf_counter", tick)
    # The clock is read once in each pass, and twice around all passes.
    assert probe_seconds() == pytest.approx(0.02, rel=0.2)
