"""Session of ``egs-warp pick`` without a page."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.plane import Plane
from egs_warp.io.picked import read_picked
from egs_warp.pipelines.pick import Pick
from egs_warp.web.pick_messages import (
    AddObject,
    Mark,
    MovePlane,
    RemoveObject,
    RenameObject,
    RunAnimate,
    Save,
    SelectObject,
    TurnFront,
    Undo,
)
from egs_warp.web.pick_session import PickSession
from tests.support.clicking import balls
from tests.support.grounds import on_folds
from tests.support.picking import events_until, picking
from tests.support.waves import wave

EACH = 1500


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[PickSession]:
    """Create a session of two balls on a floor after its proposal. Its thread has ended, so that tests can apply
    messages directly."""
    session, _ = picking(balls((-0.6, 0.9), between=1.6), tmp_path_factory.mktemp("pick") / "picked.json")
    session.prepare()
    yield session
    session.stop()


def mark(session: PickSession, ball: int, *, inside: bool = True) -> Mark:
    """Return a click on the middle of a ball, as seen from the front of the capture; the left ball is 0."""
    frame = session.source.frame
    point = frame.points(np.array([(-0.8, 0.8)[ball], -0.5, 0.5]))
    eye = frame.points(np.array([(-0.8, 0.8)[ball], -5.0, 0.5]))
    camera = Camera.look_at(eye, point, np.array([0.0, 0.0, 1.0]), width=100, height=100, vertical_fov_degrees=30.0)
    return Mark(inside, camera, ((50.0, 50.0),))


def lit(session: PickSession) -> tuple[bool, bool]:
    """Return (left, right), True for each ball that is selected."""
    mask = session.state.pick.mask
    shares = mask[:EACH].mean(), mask[EACH : 2 * EACH].mean()
    assert all(share > 0.9 or share < 0.05 for share in shares)
    return shares[0] > 0.5, shares[1] > 0.5


def test_marks_add_remove_undo_and_redo(shared: PickSession):
    shared.apply(RemoveObject())
    for message, expected in (
        (mark(shared, 0), (True, False)),
        (mark(shared, 1), (True, True)),
        (mark(shared, 0, inside=False), (False, True)),
        (Undo(), (True, True)),
        (Undo(), (True, False)),
        (Undo(redo=True), (True, True)),
    ):
        shared.apply(message)
        assert lit(shared) == expected
    event = shared.pick_event()
    assert event["undo"] and event["redo"] and event["objects"][0]["count"] > 2 * 0.9 * EACH


def test_several_objects_are_saved_in_the_frame_of_the_capture(shared: PickSession):
    shared.apply(RemoveObject())
    shared.apply(mark(shared, 0))
    shared.apply(RenameObject("left"))
    shared.apply(AddObject())
    assert shared.pick_event()["objects"][1] == {"name": "object 1", "count": 0}
    shared.apply(mark(shared, 1))
    frame = shared.source.frame
    shared.apply(TurnFront(frame.axes @ np.array([0.0, -1.0, 0.0])))
    shared.apply(SelectObject(0))
    shared.apply(Save())
    picked = read_picked(shared.source.path, shared.source.cloud)
    left, right = picked.objects
    assert (left.name, right.name, picked.selected) == ("left", "object 1", 0)
    assert left.front is None and right.front == pytest.approx([0.0, -1.0, 0.0])
    assert left.plane.plane.normal == pytest.approx([0.0, 0.0, 1.0], abs=0.02)
    assert abs(left.plane.plane.offset) < 0.02
    assert left.gaussians[:EACH].mean() > 0.9 and not left.gaussians[EACH:].any()
    labels = shared.state.labels()
    assert set(labels[:EACH]) <= {0, 1} and set(labels[EACH : 2 * EACH]) <= {0, 2}


def test_a_moved_ground_cuts_the_object(shared: PickSession):
    shared.apply(RemoveObject())
    shared.apply(mark(shared, 0))
    before, plane = shared.state.pick.mask.sum(), shared.state.pick.plane
    raised = plane.moved(0.3 * shared.source.frame.scale * plane.normal)
    shared.apply(MovePlane(raised))
    assert shared.state.pick.is_plane_given and 0.4 * before < shared.state.pick.mask.sum() < 0.9 * before
    shared.apply(Undo())
    assert shared.state.pick.mask.sum() == before and shared.state.pick.plane is plane


def test_what_cannot_be_done_is_said(shared: PickSession):
    while len(shared.state.picks) > 1:
        shared.apply(RemoveObject())
    shared.apply(RemoveObject())
    for message in (Save(), RunAnimate("jump")):
        with pytest.raises(ValueError, match="nothing is selected; click on the object first"):
            shared.apply(message)
    with pytest.raises(ValueError, match="nothing is selected yet; click on the object first"):
        shared.apply(mark(shared, 0, inside=False))
    shared.apply(RenameObject("toy"))
    shared.apply(AddObject())
    with pytest.raises(ValueError, match="another object is named toy; give another name"):
        shared.apply(RenameObject("toy"))


def test_the_thread_sends_labels_state_and_measurements(tmp_path: Path):
    session, feed = picking(balls((-0.6, 0.9), between=1.6), tmp_path / "picked.json")
    session.subscribe(lambda: None)
    session.start()
    try:
        latest = events_until(session, lambda latest: "pick" in latest)
        labels = np.frombuffer(base64.b64decode(latest["labels"]["data"]), np.uint8)
        assert np.array_equal(labels, session.state.labels())
        point = {"eye": [4, 0, 1], "target": [0, 0, 0.5], "fov": 30, "width": 100, "height": 100}
        feed.receive({"type": "mark", "inside": True, "pixels": [[1, 1]], **point})
        latest = events_until(session, lambda latest: "told" in latest)
        assert latest["told"]["text"] == "nothing is there; click on the object"
        # A page that is opened later receives the events again.
        session.subscribe(lambda: None)
        again = events_until(session, lambda latest: {"pick", "labels", "work"} <= set(latest))
        assert again["pick"]["plane"] == session.pick_event()["plane"]
        json.dumps(again)
    finally:
        session.stop()


def test_before_a_film_the_page_offers_its_motion_and_ends(tmp_path: Path):
    session, _ = picking(balls((-0.6, 0.9), between=1.6), tmp_path / "picked.json")
    session.source = replace(session.source, film="hop x2")
    session.prepare()
    session.apply(mark(session, 0))
    assert session._body_event(session.state.pick)["motions"] == [{"name": "hop x2", "why": None}]
    assert not session.has_film_request.is_set()
    session.apply(RunAnimate("hop x2"))
    assert session.has_film_request.is_set()
    assert read_picked(tmp_path / "picked.json", session.source.cloud).objects[0].gaussians[:EACH].mean() > 0.9
    event = next(one for one in session.take_events() if one["type"] == "animate")
    assert event["text"] == "is made in the terminal; this page can be closed" and not event["running"]


@pytest.mark.slow
def test_the_page_gets_the_heights_of_uneven_ground(tmp_path: Path):
    """For a ball on folds with an amplitude of 4 % of its height, the heights of the grid differ from the folds by at
    most 1 % of the height."""
    cloud, is_ball = on_folds(0.04, length=0.9)
    session, _ = picking(cloud, tmp_path / "picked.json")
    frame = session.source.frame
    # The heights are relative to the plane, wherever the user has moved it.
    plane = frame.plane(Plane(np.array([0.0, 0.0, 1.0]), -0.1))
    grid = session.ground_grid(Pick("ball", plane, is_ball))
    assert grid is not None and len(grid["heights"]) == grid["count"] ** 2
    columns, rows = np.meshgrid(*2 * [grid["spacing"] * np.arange(grid["count"])])
    flat = np.array(grid["origin"]) + columns[..., None] * grid["first"] + rows[..., None] * grid["second"]
    points = flat + np.reshape(grid["heights"], columns.shape)[..., None] * plane.normal
    captured = points.reshape(-1, 3) / frame.scale @ frame.axes + frame.origin
    seen = np.linalg.norm(captured[:, :2], axis=1) > 0.4
    np.testing.assert_allclose(captured[seen, 2], wave(captured[seen, :2], 0.04, 0.9), atol=0.01)
    assert session.ground_grid(Pick("all", plane, np.ones(cloud.count, bool))) is None


@pytest.mark.slow
def test_flat_ground_has_no_heights(shared: PickSession):
    mask = np.arange(shared.source.cloud.count) < EACH
    assert shared.ground_grid(replace(shared.state.pick, mask=mask)) is None
