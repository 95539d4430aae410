"""Page of a live creature in a real Chromium: view and controls."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egs_warp.motions.style import PRESETS, Style
from egs_warp.web.session import Session
from tests.support.chromium import wait_for_first_motion, wait_until
from tests.support.live_pages import in_browser, watched
from tests.support.page_design import check_controls


@in_browser
def test_displayed_time_is_steady_and_never_decreases(chromium: Any, session: Session):
    with watched(chromium, session) as page:
        page.keyboard.press(" ")
        wait_until(page, "egs.live.state?.doing === 'jump'")
        shown = page.evaluate(
            """() => new Promise((resolve) => {
                // After the page's own callback, with the same time of the image.
                const shown = [];
                const look = (now) => {
                    const pace = document.querySelector(".pace").textContent;
                    shown.push([egs.live.clock.time, now / 1000, egs.live.clock.lag, pace]);
                    if (shown.length < 30) requestAnimationFrame(look); else resolve(shown);
                };
                requestAnimationFrame(look);
            })"""
        )
        # A slow screen may show the end of the jump before the last image.
        assert any("stand" in pace or "jump" in pace for *_, pace in shown)
        shown, elapsed, lag = np.array([times for *times, _ in shown]).T
        assert np.diff(shown).min() >= 0.0 and shown[-1] > shown[0]
        # If the solver is slower than the screen, several images show the same frame of the solver; if the screen is
        # slow, each image advances the motion by about the time that has passed, unless it would be more than 2 s late.
        assert lag.max() <= 2.01
        is_late = lag[1:] > 1.99
        assert (is_late | (np.diff(shown) < 0.03 + 1.3 * np.diff(elapsed))).all()


@in_browser
def test_an_image_is_rendered_once_and_again_when_its_splats_are_sorted(chromium: Any, session: Session):
    with watched(chromium, session) as page:
        wait_until(page, "egs.live.state?.resting && !egs.viewers[0].sorting && !egs.viewers[0].dirty")
        left = page.evaluate(
            """() => {
                const viewer = egs.viewers[0], draw = viewer.draw.bind(viewer);
                window.drawn = 0;
                viewer.draw = () => { const done = draw(); window.drawn += done ? 1 : 0; return done; };
                viewer.show(viewer.source.frames.length - 1);
                viewer.draw();
                return viewer.dirty;
            }"""
        )
        assert left is False
        wait_until(page, "window.drawn >= 2 && !egs.viewers[0].sorting")


@in_browser
def test_pause_step_sliders_and_script(chromium: Any, session: Session):
    with watched(chromium, session) as page:
        page.keyboard.press("p")
        wait_until(page, "egs.live.state?.paused && document.querySelector('.pace').textContent === 'paused'")
        time.sleep(0.2)
        held = session.state.time
        for _ in range(2):
            page.keyboard.press(".")
        wait_until(page, f"egs.viewers[0].source.frames.at(-1).time > {held + 1.5 / 60.0}")
        assert session.state.time == pytest.approx(held + 2.0 / 60.0)
        page.click("[title='Style, friction, stiffness, pushes']")
        slider = page.locator("[aria-label=Friction]")
        slider.focus()
        page.keyboard.press("Home")
        wait_until(page, "egs.live.state?.friction === 0")
        page.keyboard.press("p")
        page.keyboard.press(" ")
        wait_until(page, "egs.live.state?.motions === 1")
        page.keyboard.press("m")
        with page.expect_download() as script:
            page.click("[title^='Save the performed motions']")
        assert script.value.suggested_filename == "script.json"
        assert json.loads(Path(script.value.path()).read_text())[0]["motion"] == "jump"


@in_browser
def test_a_motion_is_selected_by_name(chromium: Any, session: Session):
    """The panel offers all motions without a file; one that the body cannot perform is greyed out, with the reason."""
    with watched(chromium, session) as page:
        page.click("[title='Motions (m)']")
        offered = page.locator(".motions button").all_text_contents()
        assert {"twist", "look around", "bow", "spin", "get up"} < set(offered) and "trajectory" not in offered
        wave = page.locator(".motions button:text-is('wave')")
        assert wave.get_attribute("class") == "refused" and "has no branch" in wave.get_attribute("title")
        wave.click()
        wait_until(page, "egs.live.messages.some((line) => line.startsWith('wave: the body has no branch'))")
        page.keyboard.press("m")
        page.click(".motions button:text-is('twist')")
        assert not page.locator(".motions").is_visible(), "the list closes when a motion is chosen"
        wait_for_first_motion(page, "twist")
        page.keyboard.press("m")
        page.keyboard.press("Escape")
        assert not page.locator(".motions").is_visible()
        page.keyboard.press("?")
        page.keyboard.press("m")
        assert page.locator(".motions").is_visible() and not page.locator(".keys").is_visible()


@in_browser
def test_a_style_is_selected_by_name_or_by_number(chromium: Any, session: Session):
    """The page shows the style of the session; a selected style applies to the next jump."""
    with watched(chromium, session) as page:
        pressed = "[...document.querySelectorAll('.choice [aria-pressed=true]')].map((one) => one.textContent).join()"
        wait_until(page, "egs.live.state?.style.squash === 1")
        assert page.evaluate(pressed) == "usual"
        page.click("[title='Style, friction, stiffness, pushes']")
        page.click("#style-heavy")
        squash, timing = PRESETS["heavy"]["squash"], PRESETS["heavy"]["timing"]
        wait_until(page, f"egs.live.state?.style.squash === {squash} && {pressed} === 'heavy'")
        assert page.text_content("label:has([aria-label=Squash]) .value") == f"{squash:.2f}\u00d7"
        page.locator("[aria-label=Anticipation]").focus()
        page.keyboard.press("Home")
        wait_until(page, f"egs.live.state?.style.anticipation === 0.5 && {pressed} === ''")
        page.keyboard.press(" ")
        wait_until(page, "egs.live.state?.motions === 1")
        assert session.steering.requests[0].style == Style(anticipation=0.5, squash=squash, timing=timing)
        page.click("#style-usual")
        wait_until(page, f"egs.live.state?.style.timing === 1 && {pressed} === 'usual'")


@in_browser
def test_the_camera_follows_along_the_ground_but_not_a_jump(chromium: Any, session: Session):
    """A jump of 0.3 body heights stays in the picture without a movement of the camera."""
    with watched(chromium, session) as page:
        wait_until(page, "egs.live.state?.resting")
        seen = page.evaluate(
            """() => {
                const viewer = egs.viewers[0], { frames } = viewer.source, last = frames.at(-1);
                const { height } = viewer.source.header.facts;
                const seen = [];
                for (let k = 0; k <= 10; k++) {
                    const moved = [0.1 * k * height, 0, 0.3 * height * Math.sin(Math.PI * k / 10)];
                    const positions = last.positions.map((x, i) => x + moved[i % 3]);
                    frames.push({ ...last, positions, contacts: new Float32Array(0), time: last.time + k / 60 });
                    viewer.show(frames.length - 1);
                    const { camera, controls, centreOfMass } = viewer;
                    seen.push([camera.position, controls.target, centreOfMass].map((point) => point.toArray()));
                }
                return seen;
            }"""
        )
        eye, target, centre = np.array(seen).transpose(1, 0, 2) / session.creature.body.height
        np.testing.assert_allclose(np.ptp(centre, axis=0), [1.0, 0.0, 0.3], atol=1e-5)
        for point in (eye, target):
            np.testing.assert_allclose(point - point[0], (centre - centre[0]) * [1.0, 1.0, 0.0], atol=1e-5)


@in_browser
def test_the_camera_rises_to_keep_a_high_jump_in_the_picture_and_comes_back(chromium: Any, session: Session):
    """A jump of two body heights. A view that is chosen during the flight is the view from the ground."""
    with watched(chromium, session) as page:
        wait_until(page, "egs.live.state?.resting")
        eyes, tops, chosen = page.evaluate(
            """() => {
                const viewer = egs.viewers[0], { frames } = viewer.source, last = frames.at(-1);
                const { height } = viewer.source.header.facts, first = frames.length, count = 30;
                for (let k = 0; k <= count; k++) {
                    const rise = 2 * height * Math.sin(Math.PI * k / count);
                    const positions = last.positions.map((x, i) => (i % 3 === 2 ? x + rise : x));
                    const contacts = k === 0 || k === count ? last.contacts : new Float32Array(0);
                    frames.push({ ...last, positions, contacts, time: last.time + k / 60 });
                }
                const eyes = [], tops = [];
                const point = viewer.centreOfMass;
                for (let k = 0; k <= count; k++) {
                    viewer.show(first + k);
                    viewer.camera.updateMatrixWorld();
                    const { positions } = frames[first + k];
                    let top = -Infinity;
                    for (let i = 0; i < positions.length; i += 3) {
                        top = Math.max(top, point.fromArray(positions, i).project(viewer.camera).y);
                    }
                    tops.push(top);
                    eyes.push(viewer.camera.position.z / height);
                }
                viewer.show(first + count / 2);
                viewer.preset("film");
                return [eyes, tops, viewer.camera.position.z / height];
            }"""
        )
        assert max(tops) < 1.0 and 0.3 < max(eyes) - eyes[0] < 2.0
        assert eyes[-1] == pytest.approx(eyes[0], abs=1e-5) and chosen == pytest.approx(eyes[0], abs=1e-5)


@in_browser
def test_a_key_pressed_during_a_motion_shows_that_it_was_taken(chromium: Any, session: Session):
    with watched(chromium, session) as page:
        page.keyboard.press(" ")
        wait_until(page, "egs.live.state?.doing === 'jump'")
        wait_until(page, "document.querySelector('.next').textContent === ''")
        # The page shows a queued motion at once, and as long as the session reports it.
        page.keyboard.press("h")
        assert page.text_content(".next") == "next: hop"
        wait_until(page, "egs.live.state?.queued === 'hop' && egs.live.sent === undefined")
        assert page.text_content(".next") == "next: hop"
        assert page.locator(".next").is_visible()
        wait_until(page, "egs.live.state?.doing === 'hop'")
        wait_until(page, "document.querySelector('.next').textContent === ''")


@in_browser
def test_a_body_whose_steps_take_seconds_is_not_called_at_rest(chromium: Any, session: Session):
    """The page shows that a request is being computed, for as long as there is no answer, and names the motion."""
    with watched(chromium, session) as page:
        wait_until(page, "egs.live.state?.resting && document.querySelector('.pace').textContent === 'at rest'")
        shown = page.evaluate(
            """() => {
                const { live } = egs, pace = document.querySelector(".pace"), next = document.querySelector(".next");
                live.source.send = () => {};
                live.perform("jump");
                live.sent.since -= 30_000;
                live.lastMotion = -Infinity;
                const seen = [];
                const look = () => { live.updateGizmos(); seen.push([pace.textContent, next.textContent]); };
                look();
                live.show({ ...live.state, doing: "jump", resting: false });
                look();
                live.sent = { motion: "wave", since: performance.now() };
                live.handleNews({ type: "told", text: "the body cannot wave" });
                look();
                return seen;
            }"""
        )
        assert shown[0] == ["computing\u2026", "next: jump"]
        assert "jump" in shown[1][0] and shown[1][1] == "" and shown[2][1] == ""


@in_browser
def test_messages_are_shown_with_the_image_of_their_time(chromium: Any, session: Session):
    """A message waits until the picture has reached the frame before it. A picture that is drawn rarely skips frames,
    and no image lies between the poses before and after a reset."""
    with watched(chromium, session) as page:
        wait_until(page, "egs.live.state?.resting && egs.live.clock.lag === 0")
        shown = page.evaluate(
            """() => {
                const { live } = egs, { source } = egs.viewers[0], { frames } = source, { clock } = live;
                const last = frames.at(-1), start = last.time, shown = [];
                const receive = (k) => {
                    frames.push({ ...last, time: start + k / 60 });
                    clock.addArrival(k / 60);
                };
                const tell = (text) => source.receive(JSON.stringify({ type: "told", text }));
                clock.resetSpeed();
                for (let k = 1; k <= 20; k++) receive(k);
                tell("after 20 steps");
                for (let k = 21; k <= 30; k++) receive(k);
                tell("after 30 steps");
                for (let image = 0; image < 100; image++) {
                    live.advance(1 / 30);
                    const said = live.messages.at(-1);
                    shown.push([60 * (clock.time - start), said === undefined ? 0 : Number(said.split(" ")[1])]);
                }
                frames.push({ ...last, time: start + 31 / 60, isReset: true });
                clock.time = start + 30.4 / 60;
                clock.advance(0.001);
                const fromReset = frames.length - 1 - clock.framePosition;
                // One image for every three seconds.
                let lag = 0;
                for (let k = 32; k <= 1000; k++) {
                    receive(k);
                    if (k % 180 === 0) {
                        clock.advance(3);
                        lag = Math.max(lag, clock.lag);
                    }
                }
                return [shown, fromReset, lag];
            }"""
        )
        images, from_reset, lag = shown
        for step, said in images:
            # A message follows the frame that was computed before it.
            assert said == (0 if step < 20.0 - 1e-6 else 20 if step < 30.0 - 1e-6 else 30)
        assert {said for _, said in images} == {0, 20, 30} and from_reset == 0 and lag < 2.01


@in_browser
def test_a_fallen_body_can_get_up_from_its_card_also_on_a_later_page(chromium: Any, session: Session):
    """The card is shown for as long as the body lies."""
    with watched(chromium, session) as page:
        wait_until(page, "egs.live.state?.resting")
        assert not page.locator(".fallen").is_visible()
        page.evaluate("egs.live.source.send({ type: 'push', x: 0.9, y: 0, z: 0, height: 0.9 })")
        page.locator(".fallen").wait_for(timeout=60_000)
        # Messages do not remove it.
        page.evaluate("for (let k = 0; k < 4; k++) egs.live.showMessage('a message')")
        assert page.locator(".fallen").is_visible()
    with watched(chromium, session) as page:
        page.click(".fallen button:text-is('Get up')")
        wait_until(page, "egs.live.state?.doing === 'get up'")
        assert not page.locator(".fallen").is_visible()


@in_browser
def test_a_push_shows_that_it_was_taken_and_that_it_has_acted(chromium: Any, session: Session):
    """While the simulation is paused, the push waits; during a motion it acts at once and moves the body visibly."""
    lowest, height = session.creature.start.positions[:, 2].argmax(), session.creature.body.height
    with watched(chromium, session) as page:
        wait_until(page, "egs.live.state?.resting")
        page.keyboard.press("p")
        wait_until(page, "egs.live.state.paused")
        page.keyboard.press("b")
        page.wait_for_timeout(800)
        assert page.text_content(".next") == "pushing\u2026" and page.locator(".next").is_visible()
        assert page.evaluate("egs.live.state.pushes") == 0
        page.keyboard.press("Backspace")
        wait_until(page, "egs.live.state.dropped_pushes === 1 && document.querySelector('.next').textContent === ''")
        page.keyboard.press("b")
        wait_until(page, "document.querySelector('.next').textContent === 'pushing\u2026'")
        before = session.state.positions[lowest].copy()
        page.keyboard.press("p")
        wait_until(page, "document.querySelector('.next').textContent === 'pushed' && egs.live.state.pushes === 1")
        moved = 0.0
        while not page.evaluate("egs.live.state.resting"):
            moved = max(moved, float(np.linalg.norm(session.state.positions[lowest] - before)))
        assert moved > 0.02 * height
        wait_until(page, "document.querySelector('.next').textContent === ''")


@in_browser
@pytest.mark.parametrize(
    "event",
    [
        "live.show({ ...live.state, body: 'another' })",
        "live.handleNews({ error: 'push: its height is not a number' })",
        "live.pushTool.deadline = 0; live.pushTool.tick(false)",
    ],
    ids=["another body is selected", "the push is refused", "no answer arrives"],
)
def test_a_push_that_will_not_act_is_no_longer_shown(chromium: Any, session: Session, event: str):
    with watched(chromium, session) as page:
        wait_until(page, "egs.live.state?.resting")
        shown = page.evaluate(
            f"""() => {{
                const {{ live }} = egs;
                live.source.send = () => {{}};
                live.pushTool.push();
                const before = live.pushTool.news;
                {event};
                return [before, live.pushTool.news, live.pushTool.isWaiting];
            }}"""
        )
        assert shown == ["pushing\u2026", "", False]


@in_browser
@pytest.mark.parametrize("width", [560, 600, 640, 701, 760])
def test_the_controls_fit_into_windows_of_medium_width(chromium: Any, session: Session, width: int):
    with watched(chromium, session, width, 400) as page:
        assert check_controls(page, width) > 30
        dock, keys = (page.locator(part).bounding_box() for part in (".dock", ".dock [title^=Keys]"))
        assert keys["x"] + keys["width"] <= dock["x"] + dock["width"]


@in_browser
@pytest.mark.parametrize("size", [(900, 560), (390, 844)])
def test_an_open_sheet_leaves_the_creature_visible(chromium: Any, session: Session, size: tuple[int, int]):
    """Neither a sheet, nor messages above it, nor the legend of all layers covers the creature."""
    width, height = size
    outline = """(() => {
        const viewer = egs.viewers[0], { camera } = viewer, { positions } = viewer.source.frames.at(-1);
        camera.updateMatrixWorld();
        const seen = [[], []];
        for (let k = 0; k < positions.length / 3; k++) {
            const point = viewer.nodePosition(k).project(camera);
            seen[0].push((0.5 + 0.5 * point.x) * innerWidth);
            seen[1].push((0.5 - 0.5 * point.y) * innerHeight);
        }
        return seen.map((one) => [Math.min(...one), Math.max(...one)]);
    })()"""
    with watched(chromium, session, *size) as page:
        wait_until(page, "egs.live.state?.resting")
        for layer in ("cage", "muscles", "contacts", "path", "feet"):
            page.evaluate(f"egs.setLayer('{layer}', true)")
        for key, sheet in (("m", "Motions"), ("?", "Keys"), ("", "Style")):
            page.keyboard.press(key) if key else page.click("[title^=Style]")
            page.evaluate("for (let k = 0; k < 3; k++) egs.live.showMessage('a long message '.repeat(5))")
            # The picture moves with the next image.
            page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
            page.wait_for_timeout(300)
            panel = page.locator(f"section[aria-label^={sheet}]").bounding_box()
            assert panel["height"] < 0.46 * height and panel["x"] >= 0 and panel["x"] + panel["width"] <= width
            (left, _), (top, bottom) = page.evaluate(outline)
            assert top > 0 and bottom < panel["y"] + 0.02 * height, sheet
            assert bottom - top > 0.15 * height, sheet
            legend = page.locator(".legend")
            if legend.is_visible():
                box = legend.bounding_box()
                assert box["x"] + box["width"] < left, sheet
                assert box["y"] >= 0 and box["y"] + box["height"] < panel["y"], sheet


@in_browser
def test_no_image_is_drawn_before_the_splats_are_sorted(chromium: Any, session: Session):
    """An earlier image would contain the shadow without the creature. The motion continues in the meantime."""
    slow_sort = """const post = Worker.prototype.postMessage;
        Worker.prototype.postMessage = function (...message) { setTimeout(() => post.apply(this, message), 1500); };"""
    with watched(chromium, session, scripts=[slow_sort]) as page:
        seen = page.evaluate(
            """() => new Promise((resolve) => {
                const seen = [];
                const look = () => {
                    seen.push([egs.isDrawn, egs.viewers[0].hasImage]);
                    if (egs.isDrawn) resolve(seen); else requestAnimationFrame(look);
                };
                look();
            })"""
        )
        assert seen[0] == [False, False] and seen[-1] == [True, True]
        assert len(seen) > 2
        assert all(is_drawn or not has_image for is_drawn, has_image in seen[:-1])


@in_browser
def test_the_controls_of_a_phone_take_two_rows(chromium: Any, session: Session):
    with watched(chromium, session, 390, 844, has_touch=True, is_mobile=True) as page:
        dock = page.locator(".dock").bounding_box()
        assert dock["height"] < 0.14 * 844 and dock["y"] + dock["height"] <= 844
        assert check_controls(page, 390) > 30
        small = page.evaluate(
            "[...document.querySelectorAll('.dock button')].map((one) => one.getBoundingClientRect())"
            ".filter(({ width, height }) => width > 0 && Math.min(width, height) < 42).length"
        )
        assert small == 0
        page.tap("[title='Touch controls']")
        touch = page.locator("[aria-label='Touch controls'].sheet").inner_text()
        assert "tap" in touch and "pinch" in touch and "Space" not in touch and "click" not in touch


@in_browser
def test_a_phone_has_all_controls_within_reach(chromium: Any, session: Session):
    with watched(chromium, session, 360, 740) as page:
        page.click("[title^=Keys]")
        assert check_controls(page, 360) > 30
        for part in (
            ".dock",
            "#left",
            "[title^='Push it']",
            "#forward",
            "#jump",
            "[title^='Record a take']",
            "[title^=Keys]",
            ".keys",
        ):
            box = page.locator(part).bounding_box()
            assert box["x"] >= 0 and box["x"] + box["width"] <= 360 and box["y"] + box["height"] <= 740, part
        sheet = page.locator("[aria-label=Keys].sheet").bounding_box()
        assert sheet["y"] >= 0 and sheet["y"] + sheet["height"] <= page.locator(".dock").bounding_box()["y"]
        page.click("[title^=Style]")
        sheet, choice = (page.locator(part).bounding_box() for part in ("[aria-label^=Style].sheet", "#style-rubbery"))
        assert sheet["y"] >= 0 and sheet["y"] + sheet["height"] <= page.locator(".dock").bounding_box()["y"]
        assert choice["x"] + choice["width"] <= 360
        page.locator("#jump").tap() if page.evaluate("navigator.maxTouchPoints") else page.click("#jump")
        wait_for_first_motion(page, "jump")
