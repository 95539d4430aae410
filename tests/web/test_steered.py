"""Keys, gamepad and pointer that steer a creature, in a real Chromium."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egs_warp.locomotion.audit import audit
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.stance import sole_shares
from egs_warp.web.session import Session
from tests.support.chromium import wait_until
from tests.support.live_pages import KEEP_SENT, in_browser, watched

_FAR = "Math.hypot(...egs.viewers[0].centreOfMass.toArray().map((x, k) => x - {}[k])) > 0.01"
"""JavaScript that returns true when the centre of mass has moved away from a point."""
_AWAY = """() => {
    const { camera } = egs.viewers[0], way = camera.getWorldDirection(camera.position.clone());
    return [way.x, way.y].map((part) => part / Math.hypot(way.x, way.y));
}"""
"""JavaScript that returns the horizontal view direction of the camera."""


@in_browser
def test_a_key_starts_a_jump_that_the_take_records(chromium: Any, session: Session, tmp_path: Path):
    with watched(chromium, session) as page:
        page.keyboard.press("r")
        wait_until(page, "egs.live.state?.recording")
        page.keyboard.press("j")
        wait_until(page, "egs.live.state?.motions === 1 && egs.live.state.doing === 'stand'")
        heights = page.evaluate("egs.viewers[0].source.frames.map((frame) => frame.curves[0])")
        assert max(heights) - heights[0] > 0.2
        page.keyboard.press("r")
        wait_until(page, "egs.live.messages.some((line) => line.startsWith('wrote '))")
        report = json.loads((tmp_path / "take-1" / "report.json").read_text())
        assert [motion["name"] for motion in report["motion"]] == ["jump"]
        assert report["motion"][0]["reached"]["distance"] > 0.4


@in_browser
@pytest.mark.parametrize(
    ("pressed", "axes", "doing"), [([0], [0, 0], "jump"), ([], [-1, 0.2], "drive")], ids=["button", "stick"]
)
def test_a_gamepad_steers_it(chromium: Any, session: Session, pressed: list[int], axes: list[float], doing: str):
    with watched(chromium, session) as page:
        page.evaluate(
            """([pressed, axes]) => {
                const buttons = Array.from({ length: 17 }, (_, k) => ({ pressed: pressed.includes(k) }));
                const held = { mapping: "standard", buttons, axes };
                Object.defineProperty(navigator, "getGamepads", { value: () => [null, held] });
            }""",
            [pressed, axes],
        )
        wait_until(page, f"egs.live.state?.doing === '{doing}'")


@in_browser
def test_a_gamepad_pushes_it_once_for_each_press(chromium: Any, session: Session):
    with watched(chromium, session) as page:
        page.evaluate(KEEP_SENT)
        page.evaluate(
            """() => {
                const buttons = Array.from({ length: 17 }, (_, k) => ({ pressed: k === 3 }));
                const held = { mapping: "standard", buttons, axes: [0, 0] };
                const look = () => { window.looks += 1; return [held]; };
                window.press = (on) => { buttons[3].pressed = on; window.looks = 0; };
                window.looks = 0;
                Object.defineProperty(navigator, "getGamepads", { value: look });
            }"""
        )
        for on in (False, True):
            wait_until(page, "window.looks > 3")
            page.evaluate("(on) => window.press(on)", on)
        wait_until(page, "window.looks > 3")
        assert [message["type"] for message in page.evaluate("window.sent")] == ["push", "push"]


@pytest.mark.slow
@in_browser
def test_a_click_on_the_ground_sets_the_goal(chromium: Any, session: Session):
    with watched(chromium, session, 640, 480) as page:
        box = page.locator("canvas.view").bounding_box()
        page.mouse.click(box["x"] + 400, box["y"] + 300)
        wait_until(page, "egs.live.state?.goal")
        goal = np.array(page.evaluate("egs.live.state?.goal"))
        start = np.array(page.evaluate("egs.viewers[0].centreOfMass.toArray()"))[:2]
        assert np.linalg.norm(goal - start) > 0.25
        # The walk takes about a hundred steps of the solver, while the page is rendered on the same cores.
        wait_until(page, "egs.live.state?.goal === null", seconds=600.0)
        assert not [line for line in page.evaluate("egs.live.messages") if line.startswith("go")]
        place = session.steering.place
        feet = sole_shares(place.body, place.ground, place.standing) @ session.state.positions
        assert np.linalg.norm(feet[:2] - goal) < 0.15


@in_browser
def test_a_drag_pulls_at_it(chromium: Any, session: Session):
    with watched(chromium, session) as page:
        before = page.evaluate("egs.viewers[0].centreOfMass.toArray()")
        eye = "egs.viewers[0].camera.position.clone().sub(egs.viewers[0].controls.target).toArray()"
        before_the_drag = page.evaluate(eye)
        seen = page.evaluate(
            """() => {
                const viewer = egs.viewers[0], box = viewer.canvas.getBoundingClientRect();
                const p = viewer.centreOfMass.project(viewer.camera);
                return [box.left + (p.x + 1) / 2 * box.width, box.top + (1 - p.y) / 2 * box.height];
            }"""
        )
        page.mouse.move(*seen)
        page.mouse.down()
        page.mouse.move(seen[0] + 80, seen[1], steps=4)
        wait_until(page, "egs.live.state?.pulled")
        assert page.evaluate("egs.viewers[0].chosenView") == "film"
        wait_until(page, _FAR.format(before))
        page.mouse.up()
        wait_until(page, "!egs.live.state?.pulled")
        # The camera has followed the body without rotating.
        np.testing.assert_allclose(page.evaluate(eye), before_the_drag, atol=1e-3)


@in_browser
def test_a_single_click_does_not_push_it_but_says_how(chromium: Any, session: Session):
    with watched(chromium, session) as page:
        page.evaluate(KEEP_SENT)
        wait_until(page, "egs.live.state?.resting")
        box = page.locator("canvas.view").bounding_box()
        seen = page.evaluate("egs.viewers[0].centreOfMass.project(egs.viewers[0].camera).toArray()")
        page.mouse.click(box["x"] + (seen[0] + 1) / 2 * box["width"], box["y"] + (1 - seen[1]) / 2 * box["height"])
        wait_until(page, "egs.live.messages.join() === 'Double-click the body to push it there; drag it to pull it.'")
        assert page.evaluate("window.sent") == []


@in_browser
def test_a_key_a_button_and_a_double_click_push_it_away_from_the_eye(chromium: Any, session: Session, tmp_path: Path):
    with watched(chromium, session) as page:
        page.evaluate(KEEP_SENT)
        page.keyboard.press("r")
        wait_until(page, "egs.live.state?.recording")
        away, before = np.array(page.evaluate(_AWAY)), np.array(page.evaluate("egs.viewers[0].centreOfMass.toArray()"))
        page.keyboard.down("b")
        page.keyboard.down("b")  # a key that is held down repeats its event
        page.keyboard.up("b")
        page.click("[title='Push it away from you (b)']")
        wait_until(page, _FAR.format(before.tolist()))
        moved = np.array(page.evaluate("egs.viewers[0].centreOfMass.toArray()")) - before
        assert moved[:2] @ away > 0.9 * np.linalg.norm(moved[:2])
        page.click("[title='Style, friction, stiffness, pushes']")
        page.locator("[aria-label=Push]").focus()
        page.keyboard.press("ArrowLeft")
        page.click("[title='Style, friction, stiffness, pushes']")
        # The body still moves, so its head is found just before the click.
        head = page.evaluate(
            """() => {
                const viewer = egs.viewers[0], box = viewer.canvas.getBoundingClientRect();
                const place = viewer.centreOfMass.add({ x: 0, y: 0, z: 0.45 * viewer.source.header.facts.height });
                const p = place.project(viewer.camera);
                return [box.left + (p.x + 1) / 2 * box.width, box.top + (1 - p.y) / 2 * box.height];
            }"""
        )
        page.mouse.dblclick(*head)
        pushes = [message for message in page.evaluate("window.sent") if message["type"] == "push"]
        assert not [message for message in page.evaluate("window.sent") if message["type"] in ("pull", "release", "go")]
        assert ["height" in push for push in pushes] == [False, False, True] and 0.6 < pushes[2]["height"] <= 1.0
        for push, size in zip(pushes, (0.15, 0.15, 0.1), strict=True):
            assert push["z"] == 0.0 and [push["x"], push["y"]] == pytest.approx((size * away).tolist(), abs=0.02 * size)
        taken = session.state.time
        wait_until(page, f"egs.viewers[0].source.frames.at(-1).time > {taken + 0.1}")
        page.keyboard.press("r")
        wait_until(page, "egs.live.messages.some((line) => line.startsWith('wrote '))")
    trajectory = Trajectory.load(tmp_path / "take-1" / "trajectory.npz")
    given = np.einsum("n,kni->i", trajectory.node_mass, trajectory.kick_velocity)
    body = session.creature.body
    assert np.linalg.norm(given) / (body.mass * body.speed_unit) == pytest.approx(0.4, rel=0.02)
    held = audit(trajectory)
    assert max(held.momentum_residual, held.angular_momentum_residual, held.energy_residual) < 1e-6
