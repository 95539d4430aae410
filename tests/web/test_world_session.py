"""Live session of a world, in which each page steers one creature with a queue of its own."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from egs_warp.contact.contact_set import ContactSet
from egs_warp.errors import UserError
from egs_warp.fem.body import BodyState
from egs_warp.locomotion.stepper import StepReport
from egs_warp.pipelines.world import World
from egs_warp.web.packets import Frame
from egs_warp.web.world_feed import WorldFeed, WorldPageFeed, live_page_bodies
from egs_warp.web.world_session import SteeredBody, WorldSession
from tests.support.chromium import opened, wait_until
from tests.support.live_pages import in_browser
from tests.support.live_sessions import coarse_pawn
from tests.support.pages import served

pytestmark = pytest.mark.slow


def _session() -> WorldSession:
    world = World(friction=0.7)
    world.add(coarse_pawn(), heading=0.0, name="left")
    world.add(coarse_pawn(), at=(1.2, 0.0), heading=180.0, name="right")
    return WorldSession(world, live_page_bodies(world))


@pytest.fixture(scope="module")
def session() -> Iterator[WorldSession]:
    made = _session()
    yield made
    made.stop()


def _connected(feed: WorldFeed) -> WorldPageFeed:
    page = feed.connect()
    page.page.mailbox.subscribe(lambda: None, feed.session.frame)
    return page


def _texts(page: WorldPageFeed) -> list[str]:
    return [
        str(news["text"]) for news in page.page.mailbox.take_news() if not isinstance(news, Frame) and "text" in news
    ]


def test_each_page_steers_its_own_creature(session: WorldSession) -> None:
    feed = WorldFeed(session, title="two.yaml")
    first, second = _connected(feed), _connected(feed)
    states = [session.state_message(each.page) for each in (first, second)]
    assert [state["body"] for state in states] == ["left", "right"] and states[0]["bodies"]["right"] == "stand"
    first.receive({"type": "motion", "text": "jump 0.2 0.2"})
    second.receive({"type": "motion", "text": "hop 0.2 0.2"})
    session.process_requests()
    queued = [each.steering.queued for each in session.bodies if each.steering is not None]
    assert queued == ["jump", "hop"]
    session.advance()
    frame = first.page.mailbox.take_news()[-1]
    assert isinstance(frame, Frame) and len(frame.positions) == sum(len(b.cage.nodes) for b in session.page_bodies)
    second.receive({"type": "select", "body": "left"})
    assert _texts(second) == ["another page steers left, too"]
    second.receive({"type": "push", "x": 0.2, "y": 0.0, "z": 0.0})
    session.process_requests()
    assert [body.forces.has_input for body in session.bodies] == [True, False]
    first.receive({"type": "set", "friction": 0.3})
    first.receive({"type": "record", "on": True})
    session.process_requests()
    assert _texts(first) == [
        "friction and stiffness of a world are those of its file; change them there",
        "a world records no takes; egs-warp animate writes its run",
    ]
    invalid: list[dict[str, object]] = [{"type": "select", **more} for more in ({"body": "box"}, {}, {"body": 3})]
    for wrong in invalid:
        with pytest.raises(ValueError, match="select: "):
            second.receive(wrong)
    second.close()
    first.receive({"type": "stand"})
    session.process_requests()
    for body in session.bodies:
        np.testing.assert_array_equal(body.state.positions, body.member.body.start.positions)
    first.close()
    assert session.pages == []


def test_a_page_that_leaves_does_not_end_the_pull_of_another(session: WorldSession) -> None:
    """Both pages steer the same creature, but only the first one pulls it."""
    feed = WorldFeed(session, title="two.yaml")
    first, second = _connected(feed), _connected(feed)
    second.receive({"type": "select", "body": "left"})
    forces = session.bodies[0].forces
    messages: list[dict[str, object]] = [{"type": "release"}, {"type": "select", "body": "left"}]
    for message in messages:
        first.receive({"type": "pull", "node": 3, "x": 0.0, "y": 0.0, "z": 2.0})
        second.receive(message)
        session.process_requests()
        assert forces.is_pulling
    second.close()
    assert forces.is_pulling
    first.close()
    assert not forces.is_pulling


def test_a_world_without_a_creature_is_refused() -> None:
    with pytest.raises(UserError, match="world: it has no creature to steer"):
        WorldSession(World(), [])


@in_browser
def test_two_browsers_steer_two_creatures(chromium: Any) -> None:
    session = _session()
    with served(feed=WorldFeed(session, title="two.yaml")) as server:
        session.start()
        pages = [opened(chromium, server.address, 480, 360) for _ in range(2)]
        try:
            for page, _ in pages:
                wait_until(page, "egs.live.state !== undefined")
            assert [page.evaluate("egs.live.state.body") for page, _ in pages] == ["left", "right"]
            # A page that draws few images shows only some states, so the motions are long, and each page records what
            # it shows.
            shown = "[egs.live.state.bodies.left, egs.live.state.bodies.right, document.querySelector('.bodies small')"
            for page, _ in pages:
                page.evaluate(f"window.seen = []; setInterval(() => seen.push({shown}.textContent].join()), 20)")
            for (page, _), text in zip(pages, ("hop x6", "twist x6"), strict=True):
                page.evaluate(f"egs.live.source.send({{ type: 'motion', text: '{text}' }})")
            for page, _ in pages:
                wait_until(page, "seen.includes('hop,twist,hop')")
            pages[0][0].locator(".bodies .body").nth(1).click()
            wait_until(pages[0][0], "egs.live.state.body === 'right' && egs.selected === 1")
            assert pages[1][0].evaluate("egs.live.state.body") == "right"
            assert [complaints for _, complaints in pages] == [[], []]
        finally:
            for page, _ in pages:
                page.close()
            session.stop()


def test_bodies_that_push_from_the_side_are_no_support() -> None:
    """The motion receives the contacts with the ground and with a body below, but not those with a body beside it. The
    minimum gap in its report is that to the ground or to a body below."""
    gravity, positions = np.array([0.0, 0.0, -9.81]), np.eye(4, 3)
    detector = SimpleNamespace(gaps=lambda positions: (np.array([0.02, 0.5]), np.zeros(2, int)))
    stepper = SimpleNamespace(body=SimpleNamespace(gravity=gravity), detector=detector)
    upright = np.eye(3)[[2, 0, 1]]
    contacts = ContactSet(
        np.array([0, 8, 9]),
        np.tile(np.arange(4, dtype=np.int32), (3, 1)),
        np.full((3, 4), 0.25),
        np.stack([upright, upright, np.eye(3)]),
        np.zeros(3),
        np.array([0, -2, -3], np.int32),
        4,
    )
    state = BodyState(positions, np.zeros((4, 3)))
    report = StepReport(
        *(state, 0.01, contacts, np.arange(9.0).reshape(3, 3), np.array([0.02, 0.01, -0.1]), -0.1, np.zeros(0)),
        qp_count=0,
        qp_infeasible=0,
        newton_iterations=0,
        converged=True,
        added_spin=0.0,
    )
    seen: list[StepReport] = []
    member: Any = SimpleNamespace(body=SimpleNamespace(stepper=stepper))
    memory: Any = None
    steering: Any = SimpleNamespace(objectives=lambda state, report, dt: seen.append(report))
    SteeredBody(0, member, state, memory, report, steering=steering).objectives(0.01)
    assert seen[0].contacts.faces.tolist() == [0, -2] and seen[0].min_gap == 0.01
    np.testing.assert_array_equal(seen[0].forces, report.forces[:2])
