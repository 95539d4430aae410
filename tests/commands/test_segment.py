"""Commands ``plane``, ``segment`` and ``inpaint``: the files that they write, and a one-line error for every
mistake."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from egs_warp.cli import main
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.inpainting.inpaint import InpaintOptions, inpaint
from egs_warp.inpainting.inpainters import inpainter_by_name
from egs_warp.io import read_capture, write_ply
from egs_warp.io.cameras import write_cameras
from egs_warp.io.planes import PlaneRecord, read_planes, write_planes
from egs_warp.io.run_folder import MANIFEST
from egs_warp.pipelines.prepare_scene import SceneOptions, prepare_scene
from egs_warp.segmentation.clearance import StraddlingPolicy
from egs_warp.segmentation.object_spec import ObjectSpec
from tests.support.scenes import FLOOR, write_scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with scene.ply, cameras.json and the mask of the second view."""
    path = tmp_path_factory.mktemp("scene")
    mask = write_scene(path, views=6, size=96)
    corner = np.zeros_like(mask)
    corner[:6, :6] = True
    wrong_masks = {"empty": mask & False, "sky": corner, "short": mask[:50], "white": mask | True, "inverted": ~mask}
    for name, wrong in wrong_masks.items():
        (path / name).mkdir()
        Image.fromarray(wrong.astype(np.uint8) * 255).save(path / name / "photo1.png")
    away = Camera.look_at(np.array([0.0, 0.0, 9.0]), np.array([0.0, 1.0, 20.0]), np.eye(3)[1], width=96, height=96)
    write_cameras(path / "away.json", [away], ["photo1.png"])
    return path


def test_plane_then_segment_take_each_others_files(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, cameras, mask = str(folder / "scene.ply"), str(folder / "cameras.json"), str(folder / "photo1.png")
    shared = ["--object", mask, "--cameras", cameras, "--up", "z"]
    assert main(["plane", scene, *shared, "--out", str(tmp_path / "plane")]) == 0
    plane = read_planes(tmp_path / "plane" / "plane.json")[0].plane
    assert plane.normal[2] > np.cos(np.radians(0.5)) and abs(plane.offset) < 0.02
    with Image.open(tmp_path / "plane" / "plane.png") as picture:
        red, green, _ = np.moveaxis(np.asarray(picture, float), -1, 0)
        assert (red - green > 90).mean() > 0.01, "no grid in the picture"
    (found,) = read_planes(tmp_path / "plane" / "plane.json")
    other = PlaneRecord(Plane.from_coefficients(0.0, 0.0, 1.0, -0.8), support=0.1, others={"remark": "a shelf"})
    (tmp_path / "parts").mkdir()
    path = tmp_path / "parts" / "plane.json"
    write_planes(path, [found, other])
    flags = ["--plane", str(path), "--straddling", "split", "--out", str(tmp_path / "parts")]
    assert main(["segment", scene, *shared, *flags]) == 2
    assert "parts: it has plane.json, which would be mixed with this one; choose" in capsys.readouterr().err
    assert main(["segment", scene, *shared, *flags, "--overwrite"]) == 0
    assert (tmp_path / "parts" / "earlier-1" / "plane.json").is_file()
    first, second = read_planes(path)
    assert first.to_json().keys() == found.to_json().keys() | {"hole"} and first.noise == found.noise
    assert second.to_json() == other.to_json()
    thing = read_capture(tmp_path / "parts" / "object.ply").cloud
    rest = read_capture(tmp_path / "parts" / "background.ply").cloud
    assert 1450 < thing.count <= 1525
    assert 3300 < rest.count <= 3601
    np.testing.assert_allclose(read_planes(tmp_path / "parts" / "plane.json")[0].plane.normal, plane.normal, atol=1e-9)
    assert (tmp_path / "parts" / "segment.png").is_file()


@pytest.mark.slow
def test_without_cameras_a_ring_is_used_and_written(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "plane"
    assert main(["plane", str(folder / "scene.ply"), "--object", "0,-0.5,0.5", "--out", str(out)]) == 0
    assert len(list((out / "images").glob("*.png"))) == 12
    manifest = json.loads((out / MANIFEST).read_text())
    assert manifest["command"] == "plane" and manifest["finished"]
    pictures = {f"images/ring{number:02d}.png" for number in range(12)}
    assert set(manifest["files"]) == {"plane.json", "plane.png", "cameras.json", *pictures}
    assert all(len(facts["sha256"]) == 64 for facts in manifest["files"].values())
    again = ["plane", str(folder / "scene.ply"), "--object", "0,-0.5,0.5", "--out", str(out)]
    assert main(again) == 2
    assert "plane: it has an earlier run, which would be mixed with this one" in capsys.readouterr().err
    assert main(["resume", str(out)]) == 2
    assert f"{out}: it has an output of egs-warp plane, which cannot be resumed; run that" in capsys.readouterr().err
    assert main([*again, "--overwrite"]) == 0
    assert (out / "earlier-1" / "images" / "ring11.png").is_file() and len(list((out / "images").iterdir())) == 12
    # A pixel of a view in the cameras.json that the command wrote selects the object.
    flags = ["--object", "256,256", "--cameras", str(out / "cameras.json"), "--view", "0", "--straddling", "none"]
    assert main(["segment", str(folder / "scene.ply"), *flags, "--out", str(tmp_path / "parts")]) == 0


def test_a_mask_of_the_plane_is_called_by_its_flag(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ["--plane-mask", "gone.png", "--cameras", str(folder / "cameras.json"), "--out", str(tmp_path / "out")]
    assert main(["plane", str(folder / "scene.ply"), *flags]) == 2
    assert "--plane-mask gone.png: no such file or folder; check the path" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ([], "segment: give --object"),
        (
            ["--object", "0,0,0.5", "--plane", "{tmp}/no.json"],
            "no.json: no such file or folder; make it with",
        ),
        (["--object", "0,0,0.5", "--plane", "0,0,1,-5"], "no part of it lies above the plane"),
        (["--object", "0,0,0.5", "--plane", "0,0,1,0.9"], "it does not touch the plane: its lowest part is"),
        (["--object", "0,0,0.5", "--cameras", "{folder}/away.json"], "no camera sees it around the object"),
        (["--object", "{folder}/photo1.png", "--cameras", "{folder}/away.json"], "the masks' cameras see no part"),
        (
            ["--object", "{folder}/empty/photo1.png", "--cameras", "{folder}/cameras.json"],
            "the mask is empty; mark the",
        ),
        (
            ["--object", "{folder}/sky/photo1.png", "--cameras", "{folder}/cameras.json"],
            "no part of the capture is visible",
        ),
        (
            ["--object", "{folder}/short/photo1.png", "--cameras", "{folder}/cameras.json"],
            "give a mask of the photo's size",
        ),
        (
            ["--object", "{folder}/white/photo1.png", "--cameras", "{folder}/cameras.json"],
            "most of the mask lies on the floor, not on an object",
        ),
        (
            ["--object", "{folder}/inverted/photo1.png", "--cameras", "{folder}/cameras.json"],
            "most of the mask lies on the floor, not on an object",
        ),
        (["--object", "5,5,5,6,6,6"], "the box contains no Gaussian of the capture"),
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


@pytest.mark.slow
def test_inpaint_fills_the_hole_that_animate_fills(folder: Path, tmp_path: Path) -> None:
    """``plane.json`` passes the outline and the margin of the hole from ``segment`` to ``inpaint``; an object at
    another position, given to ``inpaint``, has a hole of its own."""
    cloud, spec = read_capture(folder / "scene.ply").cloud, ObjectSpec(point=np.array([0.0, -0.5, 0.5]))
    flags = ["--object", "0,-0.5,0.5", "--plane", "0,0,1,0", "--straddling", "split", "--out", str(tmp_path)]
    assert main(["segment", str(folder / "scene.ply"), *flags]) == 0
    options = SceneOptions(clearing=StraddlingPolicy.SPLIT, inpaint=False)
    prepared = prepare_scene(cloud, spec, plane=FLOOR, options=options)
    assert prepared.hole is not None
    expected = inpaint(
        prepared.background_with_hole, prepared.hole, inpainter=inpainter_by_name("ns"), options=InpaintOptions(steps=0)
    ).cloud.means.numpy()
    files = [str(tmp_path / "background.ply"), "--plane", str(tmp_path / "plane.json"), "--steps", "0"]
    filled = tmp_path / "filled.ply"
    for thing in ([], ["--object", str(tmp_path / "object.ply"), "--overwrite"]):
        assert main(["inpaint", *files, *thing, "--inpainter", "ns", "--out", str(filled)]) == 0
        np.testing.assert_allclose(read_capture(filled).cloud.means.numpy(), expected, atol=1e-5)
    thing = read_capture(tmp_path / "object.ply").cloud
    fields = (getattr(thing, name).numpy() for name in ("rotations", "log_scales", "opacity_logits", "sh"))
    away = GaussianCloud.from_numpy(thing.means.numpy() + [1.2, 0.0, 0.0], *fields)
    write_ply(tmp_path / "away.ply", away)
    assert (tmp_path / "earlier-1" / "filled.ply").is_file() and (tmp_path / "earlier-1" / "filled.png").is_file()
    picture = ["--inpainter", "ns", "--out", str(filled), "--object", str(tmp_path / "away.ply"), "--overwrite"]
    assert main(["inpaint", *files, *picture]) == 0
    assert not np.array_equal(read_capture(filled).cloud.means.numpy(), expected)
    entry = json.loads((tmp_path / "plane.json").read_text())["planes"][0]
    for damage in ({"texels": 5}, {"outlines": [["a"]]}):
        broken = {"planes": [entry | {"hole": entry["hole"] | damage}]}
        (tmp_path / "plane.json").write_text(json.dumps(broken))
        assert main(["inpaint", *files, "--out", str(filled)]) == 2
