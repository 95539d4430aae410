"""Exchange of files with PlayCanvas' splat-transform: both programs read the same counts, values and antialiasing tags.

npm downloads the tool once; the tests are skipped if the download fails. The tool reads .spz with Niantic's library,
compiled by Adobe (``@adobe/spz``).
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from egs_warp.deformation.rigid import to_body_frame
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io import read_capture, write_ply
from egs_warp.io.writing import WRITERS
from tests.support.captures import ARRAYS, make_cloud

pytestmark = pytest.mark.slow

PACKAGE = "@playcanvas/splat-transform@3.7.0"
CLOUD = replace(make_cloud(300, 3), antialiased=True)
Convert = Callable[..., Path]


@pytest.fixture(scope="module")
def convert() -> Convert:
    """Return a function that converts a file by splat-transform and returns the path of the result."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("npm is missing")
    command = [npm, "exec", "--yes", f"--package={PACKAGE}", "--", "splat-transform", "--quiet", "--overwrite"]
    try:
        # The download of the tool takes a minute or two.
        subprocess.run([*command, "--version"], capture_output=True, check=True, timeout=900)
    except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
        pytest.skip(f"npm cannot fetch {PACKAGE}: {error}")

    def run(source: Path, target: Path, *flags: str) -> Path:
        target.parent.mkdir(exist_ok=True)
        done = subprocess.run([*command, source, *flags, target], capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        return target

    return run


def assert_alike(actual: GaussianCloud, expected: GaussianCloud, *, rotation_error: float = 1e-5) -> None:
    assert (actual.count, actual.sh_degree) == (expected.count, expected.sh_degree)
    for name in ARRAYS:
        one, other = (getattr(cloud, name).numpy().astype(float) for cloud in (actual, expected))
        if name == "rotations":
            # A quaternion and its negative are the same rotation.
            one *= np.sign((one * other).sum(axis=1, keepdims=True))
        error = rotation_error if name == "rotations" else 1e-5
        np.testing.assert_allclose(one, other, rtol=0, atol=error, err_msg=name)


@pytest.mark.parametrize("kind", [kind for kind in WRITERS if kind != "glb"])
def test_our_files(kind: str, convert: Convert, tmp_path: Path) -> None:
    path = tmp_path / f"a{WRITERS[kind].ending}"
    WRITERS[kind](path, CLOUD)
    ours, theirs = (read_capture(one, device="cpu").cloud for one in (path, convert(path, tmp_path / "b.ply")))
    # The tool decodes a byte b of a quaternion in .splat as 2 b / 255 - 1, not as (b - 128) / 128.
    assert_alike(ours, theirs, rotation_error=0.012 if kind == "splat" else 1e-5)
    assert ours.antialiased is theirs.antialiased is (kind != "splat")


@pytest.mark.parametrize(
    ("name", "flags"),
    [
        ("b.compressed.ply", []),
        ("b.spz", ["--spz-version", "3"]),
        ("b.spz", ["--spz-version", "4"]),
        ("b.sog", ["--gpu", "cpu"]),
        ("unbundled/meta.json", ["--gpu", "cpu"]),
        ("streamed/lod-meta.json", ["--gpu", "cpu", "--tag-lod", "0"]),
    ],
)
def test_their_files(name: str, flags: list[str], convert: Convert, tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", CLOUD)
    path = convert(tmp_path / "a.ply", tmp_path / name, *flags)
    ours, theirs = (read_capture(one, device="cpu") for one in (path, convert(path, tmp_path / "c.ply")))
    assert_alike(ours.cloud, theirs.cloud)
    assert ours.antialiased and theirs.antialiased
    # The tool rotates a .spz so that +y is up. The rotation maps axes to axes, so only extents are compared.
    np.testing.assert_allclose(np.ptp(ours.means.numpy(), axis=0), np.ptp(CLOUD.means.numpy(), axis=0), atol=2e-3)


def test_their_glb(convert: Convert, tmp_path: Path) -> None:
    """The tool rotates a .glb by 180 degrees about z; it cannot read the format, so only its writer is tested."""
    write_ply(tmp_path / "a.ply", CLOUD)
    ours = read_capture(convert(tmp_path / "a.ply", tmp_path / "b.glb"), device="cpu")
    turned = to_body_frame(CLOUD, BodyFrame(np.diag([-1.0, -1.0, 1.0]), np.zeros(3), 1.0))
    assert_alike(ours.cloud, turned)
