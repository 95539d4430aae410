"""Videos of a finished run, which without flags equal its film, with other cameras, sizes, formats and lights."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.assets import pawn
from egs_warp.cli import main
from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.main_light import MainLight, irradiance_form
from egs_warp.io import write_ply
from egs_warp.io.run_folder import run_folder as owned
from egs_warp.io.video import VideoWriter
from egs_warp.pipelines.film import drawn_frames
from egs_warp.pipelines.finished_run import FinishedRun
from egs_warp.pipelines.render_data import RenderData
from egs_warp.pipelines.render_run import Show, render_run
from egs_warp.pipelines.shot import Shot, around, framed, nearest_steps, reframed, resized


@pytest.fixture(scope="module")
def run(run_folder: Path) -> FinishedRun:
    return FinishedRun.read(run_folder)


def _png(path: Path) -> np.ndarray:
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    return picture


def _pixels(camera: Camera, points: np.ndarray) -> np.ndarray:
    seen = points @ camera.rotation.T + camera.translation
    assert (seen[:, 2] > 0).all()
    return seen[:, :2] / seen[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def test_a_film_of_another_shape_is_filled_by_the_motion(run: FinishedRun) -> None:
    """A camera for square pictures is moved for wide ones, until the motion reaches two opposite margins."""
    points = run.trajectory.positions.reshape(-1, 3)
    base = framed(run.creature.camera, points)
    assert reframed(base, 2 * base.width, 2 * base.height, points) == resized(base, 2 * base.width, 2 * base.height)
    wide = reframed(base, 3 * base.width, 2 * base.height, points)
    np.testing.assert_allclose(wide.translation, framed(wide, points).translation, atol=1e-9)
    np.testing.assert_array_equal(wide.rotation, base.rotation)


def test_without_flags_it_is_the_film_bit_for_bit(run_folder: Path, tmp_path: Path) -> None:
    assert main(["render", str(run_folder), "--out", str(tmp_path / "again.mp4")]) == 0
    assert (tmp_path / "again.mp4").read_bytes() == (run_folder / "jump.mp4").read_bytes()


@pytest.mark.parametrize(
    "line",
    [
        "render {run} --out {run}/jump.mp4 --size 64",
        "export {run} --to bundle --out {run}/trajectory.npz",
        "convert {capture} {other}/object.ply",
    ],
)
def test_files_of_a_run_are_not_overwritten(
    line: str, run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """No command overwrites the film or the trajectory of a run or a part of a segmented scene."""
    write_ply(tmp_path / "a.ply", pawn(gaussian_count=50).cloud)
    with owned(tmp_path / "other", command="segment") as other:
        write_ply(other.file("object.ply"), pawn(gaussian_count=60).cloud)
        other.finish()
    names = {"run": run_folder, "capture": tmp_path / "a.ply", "other": tmp_path / "other"}
    words = line.format(**names).split()
    target = Path(words[words.index("--out") + 1] if "--out" in words else words[-1])
    before = target.read_bytes()
    assert main(words) == 2
    assert capsys.readouterr().err == (
        f"egs-warp: {target}: is a file of the run in {target.parent}; choose another name\n"
    )
    assert target.read_bytes() == before


@pytest.mark.parametrize("camera", ["fixed", "follow", "orbit"])
def test_every_camera_shows_the_whole_creature(camera: str, run: FinishedRun) -> None:
    shot = Shot(camera, size=(160, 90))
    steps = nearest_steps(run.trajectory.time, shot.fps)
    cameras = shot.cameras(run.creature.camera, run.trajectory, steps)
    assert len(cameras) == len(steps) == 13
    for one, step in zip(cameras, steps, strict=True):
        pixels = _pixels(one, run.trajectory.positions[step])
        assert (pixels > 0).all() and (pixels < [160, 90]).all()
    moved = any(not np.allclose(one.centre, cameras[0].centre) for one in cameras)
    assert moved == (camera != "fixed")
    if camera == "follow":
        # The camera moves only horizontally, because otherwise the floor would seem to sink in a jump.
        np.testing.assert_allclose([one.centre[2] for one in cameras], cameras[0].centre[2])


def test_the_default_camera_follows_what_travels_unless_a_scene_is_around_it(run: FinishedRun) -> None:
    base, t = run.creature.camera, run.trajectory
    steps = np.arange(len(t.time))
    places = t.positions + 0.5 * np.arange(len(steps))[:, None, None] * [1.0, 0.0, 0.0]
    far = replace(t, positions=places, time=0.5 * np.arange(len(steps)))
    base = framed(base, far.positions.reshape(-1, 3))
    following = Shot().cameras(base, far, steps)
    np.testing.assert_array_equal(following[-1].centre, Shot("follow").cameras(base, far, steps)[-1].centre)
    assert np.linalg.norm(following[-1].centre - following[0].centre) > 3.0
    assert Shot().cameras(base, far, steps, in_scene=True) == [base] * len(steps)
    still = replace(t, positions=np.repeat(t.positions[:1], len(t.positions), axis=0))
    assert Shot().cameras(run.creature.camera, still, steps) == [run.creature.camera] * len(steps)


def test_a_turn_about_it_keeps_height_and_distance(run: FinishedRun) -> None:
    positions = run.trajectory.positions[:1]
    middle = 0.5 * (positions[0].min(axis=0) + positions[0].max(axis=0))
    cameras = around(run.creature.camera, positions, count=8)
    arms = np.array([camera.centre - middle for camera in cameras])
    np.testing.assert_allclose(np.linalg.norm(arms, axis=1), np.linalg.norm(arms[0]))
    np.testing.assert_allclose(arms[:, 2], arms[0, 2])
    np.testing.assert_allclose(arms[4, :2], -arms[0, :2], atol=1e-9)
    np.testing.assert_allclose(cameras[3].rotation @ cameras[3].rotation.T, np.eye(3), atol=1e-12)


def test_a_path_goes_through_its_keys_in_the_frame_of_the_capture(run: FinishedRun, tmp_path: Path) -> None:
    t = replace(run.trajectory, body_axes=np.array([[0, 1.0, 0], [0, 0, 1], [1, 0, 0]]), metres_per_unit=0.5)
    keys = [
        {"time": 0.05, "eye": [4, 0, 2], "target": [0, 0, 1], "fov": 20},
        {"time": 0.15, "eye": [0, 5, 2], "target": [0, 0.5, 1]},
    ]
    (tmp_path / "path.json").write_text(json.dumps({"keys": keys}))
    shot = Shot(str(tmp_path / "path.json"))
    cameras = shot.cameras(run.creature.camera, t, nearest_steps(t.time, shot.fps))
    for index, key in ((0, 0), (3, 0), (9, 1), (12, 1)):
        eye = t.in_capture(cameras[index].centre)
        np.testing.assert_allclose(eye, keys[key]["eye"], atol=0.05 if index in (3, 9) else 1e-9)
        forward = cameras[index].rotation[2] @ t.body_axes
        expected = np.subtract(keys[key]["target"], keys[key]["eye"])
        np.testing.assert_allclose(forward, expected / np.linalg.norm(expected), atol=0.02)
    assert cameras[0].fy == pytest.approx(0.5 * cameras[0].height / np.tan(np.radians(10)))


def test_frames_a_second_and_size(run: FinishedRun, tmp_path: Path) -> None:
    assert render_run(run, tmp_path / "slow", Shot(size=(48, 32), fps=120.0), quiet=True) == 25
    assert _png(tmp_path / "slow" / "frame0024.png").shape == (32, 48, 3)
    with pytest.raises(UserError, match=r"slow: it has other frames \(frame0013\.png, \.\.\.\); choose another folder"):
        render_run(run, tmp_path / "slow", Shot(size=(48, 32)), quiet=True)
    camera = run.creature.camera
    assert resized(camera, camera.width, camera.height) is camera
    wide = resized(camera, 3 * camera.width, 2 * camera.height)
    points = run.trajectory.positions[0]
    expected = 2.0 * _pixels(camera, points) + [0.5 * camera.width, 0.0]
    np.testing.assert_allclose(_pixels(wide, points), expected)


def test_transparent_over_a_colour_is_the_film_over_that_colour(run: FinishedRun, tmp_path: Path) -> None:
    render_run(run, tmp_path / "clear", Shot(transparent=True, fps=5.0), quiet=True)
    render_run(run, tmp_path / "blue", Shot(colour=(0.2, 0.4, 0.8), fps=5.0), quiet=True)
    clear, blue = (_png(tmp_path / name / "frame0001.png").astype(float) for name in ("clear", "blue"))
    assert clear.shape[2] == 4 and clear[0, 0, 3] == 0 and clear[..., 3].max() > 250
    alpha = clear[..., 3:] / 255.0
    laid = alpha * clear[..., :3] + (1.0 - alpha) * 255.0 * np.array([0.8, 0.4, 0.2])
    assert np.abs(laid - blue).max() <= 2.0
    assert render_run(run, tmp_path / "bare", Shot(transparent=True, fps=5.0), shadow=False, quiet=True) == 2
    bare = _png(tmp_path / "bare" / "frame0001.png")
    assert bare[..., 3].sum() < clear[..., 3].sum()


def test_depth_is_in_millimetres_and_alpha_is_the_creatures(run: FinishedRun, tmp_path: Path) -> None:
    shot = Shot(size=(64, 64), fps=5.0)
    for show in (Show.DEPTH, Show.ALPHA):
        render_run(run, tmp_path / show.value, shot, show=show, quiet=True)
    depth, grey = _png(tmp_path / "depth" / "frame0000.png"), _png(tmp_path / "alpha" / "frame0000.png")[..., 0]
    assert depth.dtype == np.uint16
    np.testing.assert_array_equal(depth > 0, grey > 127.5)
    camera = resized(run.creature.camera, 64, 64)
    metres = (run.trajectory.positions[0] - camera.centre) @ camera.rotation[2]
    seen = depth[depth > 0] / 1000.0
    assert metres.min() - 0.1 < seen.min() and seen.max() < metres.max() + 0.1


@pytest.mark.parametrize("ending", [".mov", ".webm"])
def test_videos_keep_alpha(ending: str, run: FinishedRun, tmp_path: Path) -> None:
    """Alpha and colours survive encoding and decoding by ffmpeg; VP9 with alpha is decoded by libvpx."""
    import subprocess

    from egs_warp.io.video import ffmpeg_program

    path = tmp_path / f"a{ending}"
    shot = Shot(transparent=True, fps=5.0)
    render_run(run, path, shot, quiet=True)
    decoder = ["-c:v", "libvpx-vp9"] if ending == ".webm" else []
    size = run.creature.camera.width
    done = subprocess.run(
        [ffmpeg_program(), "-loglevel", "error", *decoder, "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgba", "-"],
        capture_output=True,
        check=True,
    )
    frames = np.frombuffer(done.stdout, np.uint8).reshape(-1, size, size, 4).astype(int)
    steps = nearest_steps(run.trajectory.time, shot.fps)
    cameras = shot.cameras(run.creature.camera, run.trajectory, steps)
    drawn = [
        frame.picture().astype(int) for frame in drawn_frames(run.deformer(), run.trajectory, steps, cameras, shot)
    ]
    assert len(frames) == len(drawn) == 2
    for read, made in zip(frames, drawn, strict=True):
        assert np.abs(read[..., 3] - made[..., 3]).mean() < 2.0
        inside = made[..., 3] > 250
        assert np.abs(read[inside, :3] - made[inside, :3]).mean() < 8.0


def test_a_main_light_changes_the_shadow_and_no_pixel_of_a_creature_at_rest(run: FinishedRun, tmp_path: Path) -> None:
    """The light is read from the file of the run and changes the shadow. The colours of the creature are bitwise the
    same until it rotates. With the light switched off, the image equals that of a run without a light."""
    direction = np.array([0.48, 0.64, 0.6])
    form = irradiance_form(0.4, 0.1, np.array([0.0, 0.0, 1.0]), 0.8, direction)
    creature = replace(run.creature, light=MainLight(direction, 5.0, 0.4, form))
    creature.save(tmp_path / "creature.npz")
    lit = replace(run, creature=RenderData.load(tmp_path / "creature.npz", node_count=len(run.mesh.nodes)))
    shot, step = Shot(size=(96, 96), transparent=True), np.zeros(1, int)
    camera = [resized(run.creature.camera, 96, 96)]
    light = lit.creature.light
    assert light is not None
    (plain,), (shone,) = (
        [*drawn_frames(run.deformer(), run.trajectory, step, camera, shot, light=one)] for one in (None, light)
    )
    assert plain.shade is not None and shone.shade is not None
    np.testing.assert_array_equal(shone.image.colour.numpy(), plain.image.colour.numpy())
    assert np.abs(shone.shade.numpy() - plain.shade.numpy()).max() > 0.1
    turned = run.trajectory.positions[:1] @ Rotation.from_euler("z", 120.0, degrees=True).as_matrix().T
    path = replace(run.trajectory, positions=turned)
    (captured,), (relit,) = (
        [*drawn_frames(run.deformer(), path, step, camera, shot, light=one)] for one in (None, light)
    )
    assert np.abs(captured.image.colour.numpy() - relit.image.colour.numpy()).max() > 0.05
    for place, one, use in (("plain", run, True), ("off", lit, False)):
        render_run(one, tmp_path / place, Shot(size=(32, 32), fps=2.0), light=use, quiet=True)
    assert (tmp_path / "plain" / "frame0000.png").read_bytes() == (tmp_path / "off" / "frame0000.png").read_bytes()


def test_a_turntable_shows_one_frame(run: FinishedRun, tmp_path: Path) -> None:
    assert render_run(run, tmp_path / "t", Shot(size=(32, 32), fps=2.0, colour=(1, 1, 1)), hold=-1, quiet=True) == 8
    first, half = _png(tmp_path / "t" / "frame0000.png"), _png(tmp_path / "t" / "frame0004.png")
    assert not np.array_equal(first, half)


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--size", "10"], "--size 10x10: give sides from 16 to 4096 pixels, such as 512 or 640x360"),
        (["--size", "wide"], "--size wide: give a side or WIDTHxHEIGHT in pixels, such as 512"),
        (["--fps", "0"], "--fps 0: give a number of frames per second from 1 to 1000"),
        (["--fps", "nan"], "--fps nan: give a number of frames per second"),
        (["--camera", "sideways"], "--camera sideways: give auto, fixed, follow, orbit or a path.json"),
        (["--camera", "none.json"], "none.json: no such file"),
        (["--camera", "{tmp}/bad.json"], "give a time, an eye [x, y, z], a target [x, y, z] and, optionally, a fov"),
        (
            ["--camera", "{tmp}/back.json"],
            "back.json: the time 0 s of key 1 is not later than 0 s of the key before it",
        ),
        (["--camera", "{tmp}/up.json"], "up.json: at 0 s, its camera points straight up or down"),
        (["--camera", "{tmp}/fov.json"], "fov.json: fov of key 0 is 180; give degrees from 1 to 150"),
        (["--background", "2,0,0"], "--background 2,0,0: give a colour: r,g,b from 0 to 1"),
        (["--background", "nowhere.ply"], "nowhere.ply: no such file"),
        (["--background", "transparent"], "--background transparent: H.264 and films of depth or alpha have no"),
        (["--turntable", "99"], "--turntable 99: the run has 13 frames; give 0 to 12, or -1"),
        (["--out", "a.avi"], "a.avi: give a name that ends in .mp4, .mov, .webm"),
    ],
)
def test_bad_input_is_one_line(
    flags: list[str], said: str, run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good = {"time": 0, "eye": [3, 0, 1], "target": [0, 0, 1]}
    for name, keys in {
        "bad": [{"time": 0, "eye": [1, 2]}],
        "back": [good, good],
        "up": [good | {"target": [3, 0, 5]}],
        "fov": [good | {"fov": 180}],
    }.items():
        (tmp_path / f"{name}.json").write_text(json.dumps({"keys": keys}))
    flags = [flag.format(tmp=tmp_path) for flag in flags]
    assert main(["render", str(run_folder), "--out", str(tmp_path / "a.mp4"), *flags]) == 2
    error = capsys.readouterr().err
    assert said in error and error.startswith("egs-warp: ") and error.count("\n") == 1
    assert not (tmp_path / "a.mp4").exists()


def test_an_mp4_has_no_alpha(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"H.264 has no alpha; give a name that ends in .mov or .webm"):
        VideoWriter(tmp_path / "a.mp4", 16, 16, alpha=True)
