"""State, history and proposals of picked objects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import concatenate
from egs_warp.geometry.plane import Plane
from egs_warp.pipelines.pick import (
    MAX_STEPS,
    Pick,
    PickHistory,
    PickState,
    is_grounded,
    located,
    marked,
    on_table_top,
    photo_warnings,
    pick_warnings,
    proposed,
    regrounded,
    resegmented,
    size_of,
    stroke_at,
)
from egs_warp.segmentation.interactive import ClickGraph
from tests.support.clicking import balls, click, front
from tests.support.grounds import level, sheet
from tests.support.scenes import blocks, lying, round_ones, shell

UP = np.array([0.0, 0.0, 1.0])
FLOOR = Plane(UP, 0.0)
EACH = 1500


@pytest.fixture(scope="module")
def apart() -> ClickGraph:
    """Create two balls with a gap between them on a floor."""
    return ClickGraph.of(balls((-0.6, 0.9), between=1.6))


def empty(graph: ClickGraph) -> Pick:
    """Return a picked object without clicks."""
    return Pick("object 1", FLOOR, np.zeros(graph.cloud.count, bool))


def test_the_history_undoes_and_redoes_and_forgets_what_was_undone():
    state = PickState((Pick("a", FLOOR, np.zeros(3, bool)),))
    history = PickHistory(state)
    assert not history.can_undo and not history.move(redo=False)
    states = [replace(state, picks=(replace(state.pick, name=name),)) for name in "bcd"]
    for one in states[:2]:
        history.push(one)
    assert history.move(redo=False) and history.state is states[0] and history.can_redo
    assert history.move(redo=True) and history.state is states[1] and not history.can_redo
    history.move(redo=False)
    history.push(states[2])
    assert history.state is states[2] and not history.move(redo=True)
    for _ in range(2 * MAX_STEPS):
        history.push(state)
    undone = 0
    while history.move(redo=False):
        undone += 1
    assert undone == MAX_STEPS


def test_labels_are_numbers_of_objects_and_the_active_one_has_precedence():
    masks = np.array([[True, True, False, False], [False, True, True, False]])
    state = PickState(tuple(Pick(f"object {k + 1}", FLOOR, mask) for k, mask in enumerate(masks)))
    assert state.labels().tolist() == [1, 1, 2, 0]
    assert state.selecting(1).labels().tolist() == [1, 2, 2, 0]
    assert state.free_name() == "object 3"
    assert [one.name for one in state.without_active().picks] == ["object 2"]
    last = state.without_active().without_active()
    assert len(last.picks) == 1 and not last.pick.mask.any()
    assert state.with_new(last.pick).active == 2


def around(point: tuple[float, float, float], *, count: int = 9, span: float = 360.0) -> list[Camera]:
    """Return ``count`` cameras that look at a point from above, on an arc of ``span`` degrees whose middle is in front
    of the point."""
    angles = np.radians(-90.0 + span * (np.arange(count) / count - 0.5))
    eyes = [np.array(point) + 3.0 * np.array([np.cos(angle), np.sin(angle), 0.5]) for angle in angles]
    return [Camera.look_at(eye, np.array(point), UP, width=80, height=80, vertical_fov_degrees=30.0) for eye in eyes]


def roll(camera: Camera, angle: float) -> Camera:
    """Return ``camera`` turned by ``angle`` about its optical axis, radians."""
    turn = Rotation.from_euler("z", angle).as_matrix()
    return replace(camera, rotation=turn @ camera.rotation, translation=turn @ camera.translation)


def test_the_proposal_of_a_scene_is_its_ground_and_the_object_at_which_the_cameras_look(apart: ClickGraph):
    pick = proposed(apart, UP, cameras=around((0.8, 0.0, 0.5)))
    assert pick.is_guess and abs(pick.plane.offset) < 0.02 and pick.plane.normal[2] > 0.999
    assert pick.mask[EACH : 2 * EACH].mean() > 0.9 and not pick.mask[:EACH].any() and not pick.is_alone
    assert pick_warnings(apart, pick) == photo_warnings(apart.cloud, pick.mask, around((0.8, 0.0, 0.5))) == ()


def test_the_frames_of_the_photos_separate_the_object_from_a_wall_that_it_touches():
    """The ball and the wall have the same colour and touch; most photos show only a part of the wall."""
    ball = round_ones(shell(), 0.025)
    wall = level((-3.0, 0.02), (3.0, 1.4), 0.51, 0.05)[:, [0, 2, 1]]
    floor = level((-3.0, -2.0), (3.0, 0.5), 0.0, 0.05)
    upright = sheet(wall, np.tile([0.0, -1.0, 0.0], (len(wall), 1)), 0.05, (0.0, 0.0, 0.0))
    graph = ClickGraph.of(concatenate(ball, upright, lying(floor)))
    is_ball = np.arange(graph.cloud.count) < ball.count
    found = proposed(graph, UP, cameras=around((0.0, 0.0, 0.5), span=120.0)).mask
    assert found[is_ball].mean() > 0.9 and found[~is_ball].mean() < 0.02


def test_a_capture_whose_photos_contain_all_of_it_is_one_object_without_its_haze():
    """The ball is surrounded by faint wide Gaussians, as after a short training with photos on a white background."""
    ball, haze = round_ones(shell(), 0.025), round_ones(1.6 * shell(60), 0.3)
    faint = replace(haze, opacity_logits=wp.full(haze.count, -4.0, dtype=wp.float32))
    faint.sh.fill_(1.5)
    graph = ClickGraph.of(concatenate(ball, faint))
    cameras = around((0.0, 0.0, 0.5))
    pick = proposed(graph, UP, cameras=cameras)
    assert pick.is_alone and pick.mask[:EACH].mean() > 0.95 and pick.mask[EACH:].mean() < 0.15
    assert pick_warnings(graph, pick) == photo_warnings(graph.cloud, pick.mask, cameras) == ()


def test_an_object_of_faint_gaussians_stands_on_its_base_without_the_haze_far_around_it():
    """Many Gaussians per pixel make a surface of faint layers, and the haze of a plain background is more opaque."""
    ball, haze = round_ones(shell(12000), 0.015), round_ones(5.0 * shell(100) - [0.0, 0.0, 2.0], 0.5)
    clouds = (
        replace(one, opacity_logits=wp.full(one.count, logit, dtype=wp.float32))
        for one, logit in ((ball, -3.0), (haze, -1.0))
    )
    graph = ClickGraph.of(concatenate(*clouds))
    cameras = around((0.0, 0.0, 0.5))
    pick = proposed(graph, UP, cameras=cameras)
    assert pick.is_alone and abs(pick.plane.offset) < 0.01
    assert pick.mask[: ball.count].mean() > 0.95 and pick.mask[ball.count :].mean() < 0.05
    assert pick_warnings(graph, pick) == photo_warnings(graph.cloud, pick.mask, cameras) == ()


def test_an_object_rests_on_its_lowest_parts_within_the_roll_of_the_cameras():
    """A box whose photos were taken with rolled cameras stands on its face, and not on an edge."""
    box = blocks(((-0.5, -0.3, 0.0), (0.5, 0.3, 0.4)))
    rolled = np.array([np.sin(np.radians(5.0)), 0.0, np.cos(np.radians(5.0))])
    cameras = [roll(camera, np.radians(8.0 * (-1) ** k)) for k, camera in enumerate(around((0.0, 0.0, 0.2), count=10))]
    graph = ClickGraph.of(box)
    pick = proposed(graph, rolled, cameras=cameras)
    assert pick.is_alone and pick.plane.normal[2] > np.cos(np.radians(1.0))
    upright = proposed(graph, UP, cameras=around((0.0, 0.0, 0.2), count=10))
    np.testing.assert_allclose(upright.plane.normal, UP, atol=1e-12)


def test_a_capture_of_one_object_is_proposed_whole():
    graph = ClickGraph.of(round_ones(shell(), 0.025))
    pick = proposed(graph, UP)
    assert pick.is_guess and pick.mask.mean() > 0.95
    assert pick.plane.normal == pytest.approx(UP) and abs(float(pick.plane.heights(graph.means).min())) < 0.05


def test_surroundings_without_a_wide_plane_are_proposed_although_few_photos_show_them():
    """The cameras look at a small ball and show little of the larger one beside it."""
    graph = ClickGraph.of(concatenate(round_ones(0.2 * shell(), 0.01), round_ones(shell() + [9.0, 0.0, 0.0], 0.025)))
    pick = proposed(graph, UP, cameras=around((0.0, 0.0, 0.1)))
    assert not pick.is_alone and pick.mask[:EACH].mean() > 0.95 and pick.mask[EACH:].mean() > 0.95
    elsewhere = ClickGraph.of(round_ones(shell() + [9.0, 0.0, 0.0], 0.025))
    assert proposed(elsewhere, UP, cameras=around((0.0, 0.0, 0.1))).mask.mean() > 0.95


def test_a_click_elsewhere_replaces_a_guess_and_a_click_beside_corrects_it(apart: ClickGraph):
    guess = np.arange(apart.cloud.count) < EACH
    pick = replace(empty(apart), mask=guess, proposal=guess, is_guess=True)
    other = marked(apart, pick, click(apart.cloud, (0.8, -0.5, 0.5)))
    assert other.mask[EACH : 2 * EACH].mean() > 0.9 and not other.mask[:EACH].any() and not other.is_guess
    both = marked(apart, replace(pick, is_guess=False), click(apart.cloud, (0.8, -0.5, 0.5)))
    assert both.mask[EACH : 2 * EACH].mean() > 0.9 and both.mask[:EACH].mean() > 0.9


def test_a_stroke_hits_what_its_pixels_hit(apart: ClickGraph):
    camera = front()
    places = [(60.0, 100.0), (62.0, 104.0), (2.0, 2.0)]
    stroke = stroke_at(apart.cloud, camera, places, inside=True)
    assert stroke is not None
    alone = [stroke_at(apart.cloud, camera, [place], inside=True) for place in places]
    assert alone[2] is None
    assert set(stroke.hits) == {hit for one in alone[:2] if one is not None for hit in one.hits}
    assert stroke_at(apart.cloud, camera, places[2:], inside=True) is None


def test_an_object_on_a_table_gets_the_table_top_as_its_ground():
    toy = 0.3 * shell() + [0.0, 0.0, 0.8]
    table = level((-0.8, -0.8), (0.8, 0.8), 0.8, 0.03)
    floor = level((-2.0, -2.0), (2.0, 2.0), 0.0, 0.05)
    graph = ClickGraph.of(concatenate(round_ones(toy, 0.008), lying(np.concatenate([table, floor]))))
    hit = click(graph.cloud, (0.0, -0.15, 0.95))
    on_floor = resegmented(graph, replace(empty(graph), clicks=(hit,)))
    on_table = on_table_top(graph, on_floor)
    assert on_table.plane.offset == pytest.approx(-0.8, abs=0.02)
    assert on_table.mask[: len(toy)].mean() > 0.9 and not on_table.mask[len(toy) :].any()
    given = replace(on_floor, is_plane_given=True)
    assert on_table_top(graph, given) is given


def test_a_first_click_selects_what_stands_on_a_pedestal_and_a_click_on_the_pedestal_adds_it():
    """The click alone selects both, because the pedestal is hardly wider than the object. The object that the command
    line finds at the same point ends at the top. Removing the pedestal puts the ground there, too."""
    toy, half = 0.3 * shell() + [0.0, 0.0, 1.2], 0.28
    pedestal = concatenate(
        blocks(((-half, -half, 0.0), (half, half, 1.2))), lying(level((-half, -half), (half, half), 1.2, 0.05))
    )
    floor = lying(level((-2.0, -2.0), (2.0, 2.0), 0.0, 0.05))
    graph = ClickGraph.of(concatenate(concatenate(round_ones(toy, 0.008), pedestal), floor))
    own, base = slice(0, len(toy)), slice(len(toy), len(toy) + pedestal.count)
    first = marked(graph, empty(graph), click(graph.cloud, (0.0, -0.15, 1.35)))
    alone = located(graph, first)
    assert alone.mask[own].mean() > 0.9 and alone.mask[base].mean() < 0.05
    assert alone.plane.offset == pytest.approx(-1.2, abs=0.03) and alone.scene_plane is FLOOR
    assert regrounded(graph, alone) is alone
    on_base = click(graph.cloud, (0.0, -half, 0.5))
    both = regrounded(graph, marked(graph, alone, on_base))
    assert both.mask[own].mean() > 0.9 and both.mask[base].mean() > 0.8 and both.plane is FLOOR
    without = regrounded(graph, marked(graph, both, replace(on_base, inside=False)))
    assert without.mask[own].mean() > 0.9 and without.mask[base].mean() < 0.3
    assert without.plane.offset < -1.0 and not any("hangs" in line for line in pick_warnings(graph, without))
    given = replace(without, plane=FLOOR, is_plane_given=True)
    assert located(graph, given) is given and regrounded(graph, given) is given


def test_an_object_without_feet_gets_no_ground_unless_a_click_removed_what_is_under_it():
    toy = 0.3 * shell() + [0.0, 0.0, 1.2]
    floor = lying(level((-2.0, -2.0), (2.0, 2.0), 0.0, 0.05))
    graph = ClickGraph.of(concatenate(round_ones(toy, 0.008), floor))
    hit = click(graph.cloud, (0.0, -0.15, 1.35))
    pick = marked(graph, empty(graph), hit)
    assert pick.mask[: len(toy)].mean() > 0.9 and not is_grounded(graph, pick)
    assert regrounded(graph, pick) is pick and any("hangs" in line for line in pick_warnings(graph, pick))
    for height, offset in ((0.5, -1.2), (2.0, 0.0)):
        removed = replace(hit, point=np.array([0.0, 0.0, height]), inside=False)
        ground = regrounded(graph, replace(pick, clicks=(hit, removed))).plane
        assert ground.offset == pytest.approx(offset, abs=0.05)


def test_an_object_warns_of_gaussians_of_another_one(apart: ClickGraph):
    rows = np.arange(apart.cloud.count)
    left, both = (replace(empty(apart), mask=rows < count) for count in (EACH, 2 * EACH))
    state = PickState((replace(left, name="left"), both), active=1)
    assert state.overlaps() == ("1,500 of its Gaussians belong to left, too; remove them from one of the two",)
    assert PickState((left, replace(both, mask=~left.mask)), active=1).overlaps() == ()


def test_warnings_name_a_remedy(apart: ClickGraph):
    whole = replace(empty(apart), mask=np.ones(apart.cloud.count, bool))
    assert pick_warnings(apart, whole) == ("it has 100 % of the capture; if other things lit up, remove them",)
    ball = replace(empty(apart), mask=np.arange(apart.cloud.count) < EACH)
    assert pick_warnings(apart, ball) == ()
    low = replace(ball, plane=Plane(UP, 1.0))
    (line,) = pick_warnings(apart, low)
    assert line.startswith("it hangs 0.5") and line.endswith("drag the ground to its feet")
    high = replace(ball, plane=Plane(UP, -5.0))
    below = "nothing of it is above the ground; drag the ground down, or click on the object"
    assert pick_warnings(apart, high) == (below,)
    assert pick_warnings(apart, empty(apart)) == () and size_of(apart, empty(apart)) == 0.0


def test_surroundings_that_came_along_are_reported(apart: ClickGraph):
    """The left ball is completely visible, so there is no warning. The whole scene fills a close view, so there is
    one."""
    close = Camera.look_at(
        np.array([0.0, -1.5, 2.5]), np.zeros(3), UP, width=400, height=300, vertical_fov_degrees=50.0
    )
    ball = np.arange(apart.cloud.count) < EACH
    assert photo_warnings(apart.cloud, ball, [front()]) == () == photo_warnings(apart.cloud, ball, [])
    (line,) = photo_warnings(apart.cloud, np.ones(apart.cloud.count, bool), [front(), close])
    assert line.startswith("it touches the picture's edges all round in ") and " of 2 photos, " in line
    assert line.endswith("; remove what does not belong to it")


def test_a_fragment_is_reported(apart: ClickGraph):
    fragment = (np.arange(apart.cloud.count) < EACH) & (apart.means[:, 2] > 0.97)
    (line,) = photo_warnings(apart.cloud, fragment, [front()])
    assert line.endswith("% of the photos; if it is only a part, click on the rest")
