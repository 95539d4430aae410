"""Every reader of external files, with a valid file and the requirements on the content that is read.

``tests/support/corruption.py`` derives inputs from them.
"""

from __future__ import annotations

import argparse
import gzip
import tempfile
import time
from collections.abc import Callable
from dataclasses import astuple, dataclass
from functools import cache
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from egs_warp.commands.animate import add_parser
from egs_warp.commands.config import with_config
from egs_warp.contact.terrain import read_terrain
from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.io import read_cameras, read_capture
from egs_warp.io.bundle import read_bundle
from egs_warp.io.cameras import PosedImage, read_points
from egs_warp.io.limits import MAX_COORDINATE, MAX_SIDE
from egs_warp.io.onnx import read_onnx
from egs_warp.io.photos import read_mask_file, read_photo
from egs_warp.io.planes import read_planes
from egs_warp.io.ply import read_point_ply
from egs_warp.io.run_folder import MANIFEST, has_finished
from egs_warp.io.text import load_json
from egs_warp.locomotion.replay import Replay
from egs_warp.motions.beats import read_beats
from egs_warp.motions.command import read_drive
from egs_warp.motions.keyframes import read_keyframes
from egs_warp.motions.route import read_path
from egs_warp.motions.script import motion
from egs_warp.muscles.files import read_muscles
from egs_warp.pipelines.object_selection import read_mask
from egs_warp.pipelines.shot import Shot
from egs_warp.training.checkpoint import Checkpoint
from egs_warp.version import __version__
from egs_warp.web.messages import read_message
from tests.support import valid_files
from tests.support.bundles import bundle_bytes, text_of, with_text
from tests.support.captures import ARRAYS, good_bytes
from tests.support.finished_runs import arrays_as_json, draw_run, finished_run, npz_of_json
from tests.support.meshes import block_mesh
from tests.support.reconstruction import COLMAP_BIN
from tests.support.slides import slide

MAX_SECONDS = 2.0
"""Maximum time to read a small file, s."""


@dataclass(frozen=True)
class Reader:
    """A reader of one kind of file, with a valid file."""

    name: str
    file: str
    """File name of the input."""
    good: Callable[[], bytes]
    read: Callable[[Path], Any]
    """Read the file and assert the requirements on its content."""
    other_files: Callable[[], dict[str, bytes]] = dict
    """Other files of the folder, by name."""
    wrap: Callable[[bytes], bytes] = bytes
    """Function that converts an input to the bytes of the file, for corruption that does not invalidate a checksum."""
    json: bool = False
    """True if the inputs are JSON trees."""


class BrokenPromiseError(AssertionError):
    """Raised if a reader returns neither a valid object nor a one-line error, or is too slow."""


def outcome(reader: Reader, folder: Path, data: bytes) -> str:
    """Read a file; return ``valid`` or ``refused``, or raise ``BrokenPromiseError``.

    A slow read is repeated and only its second time counts, because the machine may have paused during the first one.
    """
    path = folder / reader.file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(reader.wrap(data))
    first = _read(reader, path)
    if not first.slow:
        return first.result
    second = _read(reader, path)
    if second.slow:
        raise BrokenPromiseError(f"{reader.name}: {second}; {first} the first time")
    return second.result


@dataclass(frozen=True)
class _Reading:
    """Result of one reading of a file."""

    result: str
    took: float
    """Wall-clock time, s."""
    work: float
    """CPU time of all threads, s."""

    @property
    def slow(self) -> bool:
        """True if the read took too long: by CPU time, because the machine may be busy, or by a longer wall-clock time,
        because the read may block."""
        return self.work > MAX_SECONDS or self.took > 10.0 * MAX_SECONDS

    def __str__(self) -> str:
        return f"{self.work:.1f} s of work in {self.took:.1f} s"


def _read(reader: Reader, path: Path) -> _Reading:
    began, worked = time.perf_counter(), time.process_time()
    try:
        with np.errstate(all="ignore"):
            reader.read(path)
        result = "valid"
    except UserError as error:
        if "\n" in str(error):
            raise BrokenPromiseError(f"{reader.name}: more than one line: {error}") from error
        result = "refused"
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt | SystemExit):
            raise
        raise BrokenPromiseError(f"{reader.name}: {type(error).__name__}: {error}") from error
    return _Reading(result, time.perf_counter() - began, time.process_time() - worked)


def prepare(reader: Reader, folder: Path) -> None:
    """Write the other files of the input's folder."""
    for name, data in reader.other_files().items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)


# Requirements on the content --------------------------------------------------------------------------------------


def _capture(path: Path) -> None:
    cloud = read_capture(path, device="cpu").cloud
    values = {name: getattr(cloud, name).numpy() for name in ARRAYS}
    assert all(np.isfinite(array).all() for array in values.values())
    assert (np.abs(values["means"]) <= 2e4 * MAX_COORDINATE).all() and (np.abs(values["sh"]) <= 1e3).all()
    assert values["log_scales"].min() >= -100.0 and values["log_scales"].max() < 40.0
    assert np.allclose(np.linalg.norm(values["rotations"], axis=1), 1.0, atol=1e-5)


def _bundle(path: Path) -> None:
    bundle = read_bundle(path)
    for body in bundle.bodies:
        assert np.isfinite(body.splats.means.numpy()).all()
        if body.cage is not None:
            assert np.isfinite(body.cage.nodes).all() and len(body.cage.nodes) == bundle.frames


def _cameras(path: Path) -> list[PosedImage]:
    images = read_cameras(path)
    for one in images:
        camera = one.camera
        assert 1 <= camera.width <= MAX_SIDE and 1 <= camera.height <= MAX_SIDE
        numbers = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.translation, *camera.rotation.ravel()]
        assert np.isfinite(numbers).all() and min(camera.fx, camera.fy) > 0
    return images


def _photos(path: Path) -> None:
    """Read the cameras and their undistorted photos."""
    for one in _cameras(path):
        if one.image is not None:
            photo = read_photo(one, max_side=20)
            assert photo.colour.shape == (photo.camera.height, photo.camera.width, 3)
            assert np.isfinite(photo.colour).all()
            assert photo.alpha is None or 0.0 <= photo.alpha.min() <= photo.alpha.max() <= 1.0


def _colmap(path: Path) -> None:
    _cameras(path.parent)
    points = read_points(path.parent)
    assert points is None or np.isfinite([points.positions, points.colours]).all()


def _mask(path: Path) -> None:
    mask = read_mask_file(path)
    assert mask.ndim == 2 and mask.dtype == np.float32 and 0.0 <= mask.min() <= mask.max() <= 1.0


def _points(path: Path) -> None:
    positions, colours = read_point_ply(path)
    assert np.isfinite(positions).all() and np.isfinite(colours).all()


def _planes(path: Path) -> None:
    for known in read_planes(path):
        assert np.isclose(np.linalg.norm(known.plane.normal), 1.0) and np.isfinite(known.plane.offset)
        assert known.hole is None or (np.isfinite(known.hole.centre).all() and max(known.hole.texels) <= 8192)


def _terrain(path: Path) -> None:
    for solid in read_terrain(path):
        assert all(np.isfinite([*face.normal, face.offset]).all() for face in solid.faces)


def _muscles(path: Path) -> None:
    muscles = read_muscles(path, block_mesh(), body_weight=10.0)
    assert np.isfinite(muscles.stiffness).all() and muscles.segment_count <= 400


def _script(path: Path) -> None:
    assert 1 <= motion(str(path)).frames() < 10**6


def _line(path: Path) -> None:
    assert 1 <= motion(path.read_bytes().decode("latin-1")).frames() < 10**6


def _keys(path: Path) -> None:
    for key in read_keyframes(path):
        assert np.isfinite([key.time, *key.value, key.weight]).all()


def _camera_path(path: Path) -> None:
    Shot(str(path)).check()


class _Flags(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UserError(message)


def _config(path: Path) -> None:
    add_parser(commands := _Flags().add_subparsers())
    assert f"--config={path}" in with_config(["--config", str(path)], commands.choices["animate"])


def _photo(path: Path) -> None:
    photo = read_photo(
        PosedImage("a", Camera(24, 16, 30.0, 30.0, 12.0, 8.0, np.eye(3), np.zeros(3)), path), max_side=20
    )
    assert photo.colour.shape == (photo.camera.height, photo.camera.width, 3)


@cache
def _record() -> dict[str, bytes]:
    """Return the files, by name, that a recorder writes for eight steps."""
    slid = slide()
    with tempfile.TemporaryDirectory() as folder:
        recorder = slid.recorder(folder=lambda: Path(folder))
        for report in slid.reports[:8]:
            recorder.add([report])
        recorder.trajectory()
        return {path.name: path.read_bytes() for path in Path(folder).iterdir()}


def _replayed(path: Path) -> None:
    slid = slide()
    replay = Replay(path.parent, slid.recorder().start)
    reports = [report for _ in slid.reports for report in replay.step(0)]
    assert len(reports) == 8 and all(np.isfinite(report.state.positions).all() for report in reports)


def _beats(path: Path) -> None:
    beats = read_beats(path)
    assert beats and np.isfinite(beats).all() and (np.diff(beats) > 0.0).all()


def _path(path: Path) -> None:
    assert np.isfinite(read_path(path)).all()


def _drive(path: Path) -> None:
    plan = read_drive(path)
    assert 0.0 <= plan.seconds < 1e5 and np.isfinite(astuple(plan.at(plan.seconds))).all()


_MESSAGES = [
    *({"type": "motion", "text": "hop x3, twist 90"}, {"type": "go", "x": 0.5, "y": -0.2}),
    *({"type": "drive", "forward": 0.3, "turn": 0.5}, {"type": "pull", "node": 3, "x": 0.1, "y": 0.0, "z": 0.2}),
    *({"type": "push", "x": 0.1, "y": 0.0, "z": 0.0, "height": 0.8}, {"type": "set", "friction": 0.5, "sag": 0.03}),
    *({"type": "pause", "on": True}, {"type": "cancel"}, {"type": "record", "on": False}),
]


def _messages(path: Path) -> None:
    """Read messages as the server of ``live`` does; an invalid one gives a one-line error."""
    try:
        tree = load_json(path.read_bytes())
        for message in tree if isinstance(tree, list) else [tree]:
            if not isinstance(message, dict):
                raise ValueError("not an object")
            read_message(message, height=1.0, node_count=50)
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(str(error)[:200].replace("\n", " ")) from None


_MANIFEST = {
    **{"schema": 1, "version": __version__, "command": "animate", "finished": False},
    "files": {"run.yaml": None, "a/b.ply": {"bytes": 3, "sha256": "0" * 64}},
}


def _manifest(path: Path) -> None:
    (path.parent / "run.yaml").touch()
    assert has_finished(path.parent) in (True, False)


@cache
def _training() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        checkpoint = Checkpoint(Path(folder) / "a.training.npz")
        checkpoint.begin("digest")
        checkpoint.write({"step": 3, "losses": np.arange(3.0), "queue": [1, 2], "order": {"state": 2**100}})
        return checkpoint.path.read_bytes()


def _trained(path: Path) -> None:
    state = Checkpoint(path, resume=True).begin("digest")
    assert state is not None and state["losses"].shape == (3,)


_NPZ = ("trajectory.npz", "creature.npz")
READERS: tuple[Reader, ...] = (
    Reader("ply", "a.ply", lambda: good_bytes("a.ply"), _capture),
    Reader("text ply", "a.ply", valid_files.text_ply, _capture),
    Reader("compressed ply", "a.ply", lambda: good_bytes("b.ply"), _capture),
    Reader("spz", "a.spz", lambda: good_bytes("a.spz"), _capture),
    Reader("spz inside gzip", "a.spz", lambda: gzip.decompress(good_bytes("a.spz")), _capture, wrap=gzip.compress),
    Reader("spz of streams", "a.spz", valid_files.streamed_spz, _capture),
    Reader("glb", "a.glb", valid_files.glb, _capture),
    Reader("gltf", "a.gltf", valid_files.gltf, _capture, json=True),
    Reader("packed glb", "a.glb", valid_files.packed_glb, _capture),
    Reader("packed gltf", "a.gltf", valid_files.packed_gltf, _capture, json=True),
    Reader("ply of other tools", "a.ply", valid_files.ply_variant, _capture),
    Reader("quantized gltf", "a.gltf", valid_files.quantized_gltf, _capture, json=True),
    Reader("activated ply", "a.ply", valid_files.activated_ply, _capture),
    Reader("georeferenced ply", "a.ply", valid_files.georeferenced_ply, _capture),
    Reader("splat", "a.splat", lambda: good_bytes("a.splat"), _capture),
    Reader("sog", "a.sog", lambda: good_bytes("a.sog"), _capture),
    Reader(
        "sog meta", "a.sog", lambda: valid_files.sog()["meta.json"], _capture, wrap=valid_files.zip_with_meta, json=True
    ),
    Reader(
        "sog picture",
        "means_u.webp",
        lambda: valid_files.sog()["means_u.webp"],
        lambda p: _capture(p.parent),
        other_files=valid_files.sog,
    ),
    Reader(
        **{"name": "lod-meta", "file": "lod-meta.json", "good": valid_files.lod_meta, "read": _capture, "json": True},
        other_files=lambda: {f"0_0/{name}": data for name, data in valid_files.sog().items()},
    ),
    Reader("bundle", "a.egs", bundle_bytes, _bundle),
    Reader(
        "bundle text",
        "a.egs",
        lambda: valid_files.json_bytes(text_of(bundle_bytes())),
        _bundle,
        wrap=with_text,
        json=True,
    ),
    Reader("cameras.json", "cameras.json", lambda: valid_files.json_bytes(valid_files.INRIA), _cameras, json=True),
    Reader(
        "transforms.json",
        "transforms.json",
        lambda: valid_files.json_bytes(valid_files.TRANSFORMS),
        _cameras,
        json=True,
    ),
    *(
        Reader(f"colmap {name}", name, lambda name=name: valid_files.COLMAP[name], _colmap, lambda: valid_files.COLMAP)
        for name in valid_files.COLMAP
    ),
    *(
        Reader(f"colmap {name}", name, lambda name=name: COLMAP_BIN[name], _colmap, lambda: COLMAP_BIN)
        for name in COLMAP_BIN
    ),
    Reader(
        "transforms.json without sizes",
        "transforms.json",
        lambda: valid_files.json_bytes(valid_files.SIZELESS),
        _photos,
        valid_files.adjacent_photo,
        json=True,
    ),
    Reader(
        "colmap lenses",
        "cameras.txt",
        lambda: valid_files.colmap_of_lenses()["cameras.txt"],
        lambda p: _photos(p.parent),
        valid_files.colmap_of_lenses,
    ),
    Reader("reality scan", "cameras.csv", lambda: valid_files.REALITY_SCAN, _photos, valid_files.adjacent_photo),
    Reader(
        "reality scan with commas",
        "cameras.csv",
        lambda: valid_files.REALITY_SCAN_COMMAS,
        _photos,
        valid_files.adjacent_photo,
    ),
    Reader("metashape", "cameras.xml", lambda: valid_files.METASHAPE, _photos, valid_files.adjacent_photo),
    Reader("old metashape", "cameras.xml", lambda: valid_files.OLD_METASHAPE, _photos, valid_files.adjacent_photo),
    Reader("mask of a photo", "mask.png", lambda: valid_files.picture("PNG", "RGBA"), _mask),
    Reader("point ply", "input.ply", valid_files.point_ply, _points),
    Reader("plane.json", "plane.json", lambda: valid_files.json_bytes(valid_files.PLANES), _planes, json=True),
    Reader(
        "terrain",
        "terrain.json",
        lambda: valid_files.json_bytes([[[0, 0, 1, -0.1], [-1, 0, 0, 0.5]]]),
        _terrain,
        json=True,
    ),
    Reader("muscles", "muscles.json", lambda: valid_files.json_bytes(valid_files.MUSCLES), _muscles, json=True),
    Reader("script", "script.json", lambda: valid_files.json_bytes(valid_files.SCRIPT), _script, json=True),
    Reader("motion line", "line.txt", lambda: b"hop x3, twist 180, walk to 1,0.5, walk 2, jump 0.5 height=0.3", _line),
    Reader("key frames", "keys.json", lambda: valid_files.json_bytes(valid_files.KEYS), _keys, json=True),
    Reader("key frames csv", "keys.csv", lambda: valid_files.CSV, _keys),
    Reader("camera path", "path.json", lambda: valid_files.json_bytes(valid_files.PATH), _camera_path, json=True),
    Reader("run.yaml", "run.yaml", lambda: valid_files.CONFIG, _config),
    Reader("recorded start", "start.npz", lambda: _record()["start.npz"], _replayed, other_files=_record),
    Reader("recorded steps", "steps-000000.npz", lambda: _record()["steps-000000.npz"], _replayed, other_files=_record),
    Reader("mask", "mask.png", lambda: valid_files.picture("PNG", "L"), read_mask),
    Reader("photo png", "a.png", lambda: valid_files.picture("PNG", "RGB"), _photo),
    Reader("photo jpeg", "a.jpg", lambda: valid_files.picture("JPEG", "RGB"), _photo),
    Reader("onnx", "a.onnx", valid_files.network, read_onnx),
    Reader("beats", "beats.csv", lambda: b"beat\n0.5\n1.0\n1.5\n", _beats),
    Reader("way", "way.csv", lambda: b"ahead,left\n0.2,0\n0.5,0.1\n0.9,-0.2\n", _path),
    Reader("drive", "drive.csv", lambda: b"time,forward,sideways,turn\n0,0.3,0,0\n2,0.1,0.1,0.5\n4,0,0,0\n", _drive),
    Reader("message of the page", "message.json", lambda: valid_files.json_bytes(_MESSAGES), _messages, json=True),
    Reader("manifest", MANIFEST, lambda: valid_files.json_bytes(_MANIFEST), _manifest, json=True),
    Reader("training to go on with", "a.training.npz", _training, _trained),
    *(Reader(f"run: {name}", name, lambda name=name: finished_run()[name], draw_run, finished_run) for name in _NPZ),
    *(
        Reader(
            **{"name": f"arrays of {name}", "file": name, "good": lambda name=name: arrays_as_json(name)},
            **{"read": draw_run, "other_files": finished_run, "wrap": npz_of_json, "json": True},
        )
        for name in _NPZ
    ),
    Reader("report of a run", "report.json", lambda: finished_run()["report.json"], draw_run, finished_run, json=True),
)
