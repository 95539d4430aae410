"""The commands from a scene to its parts: files, and one line for every mistake."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from egs_warp.assets import scene
from egs_warp.cli import main
from egs_warp.commands.scene_flags import SceneInput
from egs_warp.commands.scene_planes import planes_of_scene
from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.camera_ring import ring_cameras
from egs_warp.geometry.gaussians import GaussianCloud, joined
from egs_warp.geometry.plane import Plane
from egs_warp.inpainting.inpaint import InpaintOptions, inpaint
from egs_warp.inpainting.inpainters import inpainter_by_name
from egs_warp.io import read_capture, write_ply
from egs_warp.io.cameras import write_cameras
from egs_warp.io.planes import read_planes, read_planes_and_facts, write_planes
from egs_warp.pipelines.pictures import picture_cameras, plane_picture
from egs_warp.pipelines.prepare_scene import SceneOptions, prepare_scene, viewing_direction
from egs_warp.render import render
from egs_warp.segmentation.clearance import Clearing, ClearingOptions, clear_plane, reach_across
from egs_warp.segmentation.object_mask import ObjectSpec, masks_from_selection
from tests.support.scenes import FLOOR, ball_on_floor


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """scene.ply, cameras.json, and the mask of its second view."""
    path = tmp_path_factory.mktemp("scene")
    cloud, truth = ball_on_floor()
    write_ply(path / "scene.ply", cloud)
    cameras = ring_cameras(FLOOR, np.array([0.0, 0.0, 0.5]), 0.9, count=6, size=96)
    write_cameras(path / "cameras.json", cameras, [f"photo{k}.png" for k in range(6)])
    mask = masks_from_selection(cloud, truth, cameras[1:2])[0].mask
    Image.fromarray(mask.astype(np.uint8) * 255).save(path / "photo1.png")
    corner = np.zeros_like(mask)
    corner[:6, :6] = True
    wrong_masks = {"empty": mask & False, "sky": corner, "short": mask[:50], "white": mask | True, "inverted": ~mask}
    for name, wrong in wrong_masks.items():
        (path / name).mkdir()
        Image.fromarray(wrong.astype(np.uint8) * 255).save(path / name / "photo1.png")
    away = Camera.look_at(np.array([0.0, 0.0, 9.0]), np.array([0.0, 1.0, 20.0]), np.eye(3)[1], width=96, height=96)
    write_cameras(path / "away.json", [away], ["photo1.png"])
    return path


def test_plane_then_segment_take_each_others_files(folder: Path, tmp_path: Path) -> None:
    scene, cameras, mask = str(folder / "scene.ply"), str(folder / "cameras.json"), str(folder / "photo1.png")
    shared = ["--object", mask, "--cameras", cameras, "--up", "z"]
    assert main(["plane", scene, *shared, "--out", str(tmp_path / "plane")]) == 0
    plane = read_planes(tmp_path / "plane" / "plane.json")[0]
    assert plane.normal[2] > np.cos(np.radians(0.5)) and abs(plane.offset) < 0.02
    with Image.open(tmp_path / "plane" / "plane.png") as picture:
        red, green, _ = np.moveaxis(np.asarray(picture, float), -1, 0)
        assert (red - green > 90).mean() > 0.01, "no grid in the picture"
    found = read_planes_and_facts(tmp_path / "plane" / "plane.json")
    found.append((Plane.from_coefficients(0.0, 0.0, 1.0, -0.8), {"support": 0.1}))
    (tmp_path / "parts").mkdir()
    path = tmp_path / "parts" / "plane.json"
    write_planes(path, [one for one, _ in found], facts=[facts for _, facts in found])
    flags = ["--plane", str(path), "--straddling", "split"]
    assert main(["segment", scene, *shared, *flags, "--out", str(tmp_path / "parts")]) == 0
    first, second = read_planes_and_facts(path)
    assert first[1].keys() == found[0][1].keys() | {"hole"} and first[1]["noise"] == found[0][1]["noise"]
    assert second[0].offset == -0.8 and second[1] == {"support": 0.1}
    thing = read_capture(tmp_path / "parts" / "object.ply").cloud
    rest = read_capture(tmp_path / "parts" / "background.ply").cloud
    assert 1450 < thing.count <= 1525
    assert 3300 < rest.count <= 3601
    np.testing.assert_allclose(read_planes(tmp_path / "parts" / "plane.json")[0].normal, plane.normal, atol=1e-9)
    assert (tmp_path / "parts" / "segment.png").is_file()


def test_without_cameras_a_ring_is_used_and_written(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "plane"
    assert main(["plane", str(folder / "scene.ply"), "--object", "0,-0.5,0.5", "--out", str(out)]) == 0
    assert len(list((out / "images").glob("*.png"))) == 12
    # What was written can be clicked on.
    flags = ["--object", "256,256", "--cameras", str(out / "cameras.json"), "--view", "0", "--straddling", "none"]
    assert main(["segment", str(folder / "scene.ply"), *flags, "--out", str(tmp_path / "parts")]) == 0


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ([], "segment: give --object"),
        (["--object", "0,0,0.5", "--plane", "{tmp}/no.json"], "no.json: no such file; make it with egs-warp plane"),
        (["--object", "0,0,0.5", "--plane", "0,0,1,-5"], "nothing of it lies above the plane"),
        (["--object", "0,0,0.5", "--plane", "0,0,1,0.9"], "it touches no plane: its lowest part is"),
        (["--object", "0,0,0.5", "--cameras", "{folder}/away.json"], "no camera sees it around the object"),
        (["--object", "{folder}/photo1.png", "--cameras", "{folder}/away.json"], "the masks' cameras see nothing"),
        (
            ["--object", "{folder}/empty/photo1.png", "--cameras", "{folder}/cameras.json"],
            "the mask is empty; mark the",
        ),
        (["--object", "{folder}/sky/photo1.png", "--cameras", "{folder}/cameras.json"], "nothing of the capture shows"),
        (
            ["--object", "{folder}/short/photo1.png", "--cameras", "{folder}/cameras.json"],
            "make it at the photo's size",
        ),
        (
            ["--object", "{folder}/white/photo1.png", "--cameras", "{folder}/cameras.json"],
            "most of the mask lies on the floor, not on an object",
        ),
        (
            ["--object", "{folder}/inverted/photo1.png", "--cameras", "{folder}/cameras.json"],
            "most of the mask lies on the floor, not on an object",
        ),
        (["--object", "5,5,5,6,6,6"], "the box holds nothing of the capture"),
    ],
)
def test_mistakes_are_one_line(
    folder: Path, tmp_path: Path, flags: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [flag.format(folder=folder, tmp=tmp_path) for flag in flags]
    status = main(["segment", str(folder / "scene.ply"), "--up", "z", *given, "--out", str(tmp_path / "out")])
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("egs-warp:")]
    assert status == 2
    assert message in lines[-1]


def test_photographs_beside_the_cameras_clear_the_plane(folder: Path) -> None:
    """Eq. (21) against photographs of the whole scene; a photo of another size than its camera is no photo of it."""
    pytest.importorskip("torch")
    from egs_warp.commands.scene_flags import SceneInput
    from egs_warp.io import read_cameras
    from egs_warp.training.photo_colours import in_colours_of, photographs_in_colours_of

    cloud, truth = ball_on_floor()
    posed = read_cameras(folder / "cameras.json")
    images = folder / "images"
    images.mkdir(exist_ok=True)
    for one in posed[:5]:
        picture = render(cloud, one.camera, background=(0.0, 0.0, 0.0)).colour_srgb8()
        Image.fromarray(picture[:50] if one is posed[4] else picture).save(images / one.name)
    given = SceneInput(cloud, read_cameras(folder / "cameras.json"), None, None, None, ())
    photographs = photographs_in_colours_of(given.cloud, given.posed)
    assert len(photographs) == 4
    assert photographs[0].image.shape == (96, 96, 3)
    expected = render(cloud, posed[0].camera, background=(0.0, 0.0, 0.0)).colour.numpy()
    np.testing.assert_allclose(photographs[0].image, np.clip(expected, 0.0, 1.0), atol=1.0 / 255)
    # Taken at a third of the exposure, in a warmer light, and with a stranger in front.
    expected = np.clip(expected, 0.0, 1.0)
    toned = expected * [0.4, 0.33, 0.25] + 0.02
    toned[70:80, 40:60] = 1.0
    matched = in_colours_of(expected, toned, expected.max(axis=2) > 0.1)
    np.testing.assert_allclose(matched[:70], expected[:70], atol=1.0 / 255)
    thing = cloud.subset(truth & (cloud.means.numpy()[:, 2] > 0.0))
    tuned = clear_plane(
        thing,
        FLOOR,
        Clearing.FINETUNE,
        views=photographs,
        surroundings=cloud.subset(~truth),
        options=ClearingOptions(iterations=60, subdivisions=0, weight=3.0),
    )

    def crossing(one: GaussianCloud) -> float:
        heights, reach = reach_across(one, FLOOR)
        return float(np.maximum(reach - np.abs(heights), 0.0).sum())

    assert thing.count - 10 <= tuned.count <= thing.count
    assert crossing(tuned) < 0.6 * crossing(thing)


def test_inpaint_fills_the_hole_that_animate_fills(folder: Path, tmp_path: Path) -> None:
    """Outline and margin go from segment to inpaint by plane.json; an object elsewhere has its own foot."""
    cloud, spec = read_capture(folder / "scene.ply").cloud, ObjectSpec(point=np.array([0.0, -0.5, 0.5]))
    flags = ["--object", "0,-0.5,0.5", "--plane", "0,0,1,0", "--straddling", "split", "--out", str(tmp_path)]
    assert main(["segment", str(folder / "scene.ply"), *flags]) == 0
    options = SceneOptions(clearing=Clearing.SPLIT, inpaint=False)
    prepared = prepare_scene(cloud, spec, plane=FLOOR, options=options)
    expected = inpaint(
        prepared.bare, prepared.hole, inpainter=inpainter_by_name("ns"), options=InpaintOptions(steps=0)
    ).cloud.means.numpy()
    files = [str(tmp_path / "background.ply"), "--plane", str(tmp_path / "plane.json"), "--steps", "0"]
    filled = tmp_path / "filled.ply"
    for thing in ([], ["--object", str(tmp_path / "object.ply")]):
        assert main(["inpaint", *files, *thing, "--inpainter", "ns", "--out", str(filled)]) == 0
        np.testing.assert_allclose(read_capture(filled).cloud.means.numpy(), expected, atol=1e-5)
    thing = read_capture(tmp_path / "object.ply").cloud
    fields = (getattr(thing, name).numpy() for name in ("rotations", "log_scales", "opacity_logits", "sh"))
    away = GaussianCloud.from_numpy(thing.means.numpy() + [1.2, 0.0, 0.0], *fields)
    write_ply(tmp_path / "away.ply", away)
    picture = ["--inpainter", "ns", "--out", str(filled), "--object", str(tmp_path / "away.ply")]
    assert main(["inpaint", *files, *picture]) == 0
    assert not np.array_equal(read_capture(filled).cloud.means.numpy(), expected)
    entry = json.loads((tmp_path / "plane.json").read_text())["planes"][0]
    for damage in ({"texels": 5}, {"outlines": [["a"]]}):
        broken = {"planes": [entry | {"hole": entry["hole"] | damage}]}
        (tmp_path / "plane.json").write_text(json.dumps(broken))
        assert main(["inpaint", *files, "--out", str(filled)]) == 2


def test_further_planes_are_level_patches_in_colours_of_their_own() -> None:
    """Beside a bedroom's floor only the stool's board and cushion are level; slices of walls and legs are no planes."""
    made = scene("stool")
    cloud = joined(made.background, made.object)
    given = SceneInput(cloud, [], ObjectSpec(point=np.array([0.0, 0.0, 0.68])), None, made.plane, ())
    found = planes_of_scene(given, plane_mask=None, view=None, count=5)
    assert [-one.offset for one in found.planes] == pytest.approx([0.0, 0.52, 0.68], abs=0.01)
    assert all(one.normal[2] > np.cos(np.radians(1.0)) for one in found.planes)
    assert found.notes[-1] == "3 of 5 planes found"
    cameras = picture_cameras(made.plane, found.centre, found.size)[1:2]
    picture = plane_picture(cloud, found.planes[:2], cameras, centre=found.centre, size=found.size).astype(float)
    red, green, _ = np.moveaxis(picture, -1, 0)
    assert (red - green > 90).mean() > 0.01
    assert (green - red > 60).mean() > 0.002


def test_a_capture_with_nothing_flat_has_one_plane() -> None:
    """Round Gaussians on a grid: the plane that is given, and none beside it."""
    x, y = (values.ravel() for values in np.meshgrid(np.linspace(-1.0, 1.0, 40), np.linspace(-1.0, 1.0, 40)))
    means = np.stack([x, y, np.zeros_like(x)], axis=1)
    box = (np.abs(x) < 0.2) & (np.abs(y) < 0.2)
    means = np.concatenate([means, *(means[box] + [0.0, 0.0, height] for height in np.linspace(0.03, 0.6, 12))])
    count = len(means)
    cloud = GaussianCloud.from_numpy(
        means,
        np.tile([1.0, 0, 0, 0], (count, 1)),
        np.full((count, 3), -3.5),
        np.full(count, 4.0),
        np.zeros((count, 1, 3)),
    )
    given = SceneInput(cloud, [], ObjectSpec(point=np.array([0.0, 0.0, 0.3])), None, FLOOR, ())
    found = planes_of_scene(given, plane_mask=None, view=None, count=2)
    assert len(found.planes) == 1 and found.notes[-1] == "1 of 2 planes found"


def test_plane_files_are_checked(tmp_path: Path) -> None:
    path = tmp_path / "plane.json"
    planes = [FLOOR, Plane.from_coefficients(0.0, 1.0, 0.0, 2.0)]
    write_planes(path, planes, facts=[{"noise": 0.01}])
    for one, other in zip(read_planes(path), planes, strict=True):
        np.testing.assert_allclose([*one.normal, one.offset], [*other.normal, other.offset])
    for text, message in (
        ("{", "not readable JSON"),
        ("[]", "it has no planes"),
        ('{"planes": [{"normal": [1, 2]}]}', "plane 0 needs normal"),
        ('{"planes": [{"normal": [0, 0, 0], "offset": 1}]}', "a normal that is not zero"),
        (f'{{"planes": [{{"normal": [0, 0, {401 * "1"}], "offset": 1}}]}}', "give four finite numbers"),
    ):
        path.write_text(text)
        with pytest.raises(UserError, match=message):
            read_planes(path)


def test_a_scene_is_prepared_whole_and_seen_from_where_it_was_taken() -> None:
    cloud, _ = ball_on_floor()
    stages: list[str] = []
    prepared = prepare_scene(
        cloud,
        ObjectSpec(point=np.array([0.0, -0.5, 0.5])),
        options=SceneOptions(clearing=Clearing.SPLIT, inpaint=False),
        progress=stages.append,
    )
    assert stages == ["plane", "segment"]
    assert prepared.background is prepared.bare
    assert any("straddled the plane: static split" in note for note in prepared.notes)
    cameras = ring_cameras(FLOOR, np.array([0.0, 0.0, 0.5]), 0.9, count=3, elevations=(20.0, 40.0, 60.0))
    direction = viewing_direction(prepared, cameras)
    np.testing.assert_allclose(direction, cameras[1].centre - prepared.located.centre)
    up = viewing_direction(prepared, [])
    assert 0.3 < up @ prepared.plane.normal / np.linalg.norm(up) < 0.6
