"""Messages about files and folders that are given as a capture although they are of another known kind."""

from __future__ import annotations

from pathlib import Path

import pytest

from egs_warp.errors import UserError
from egs_warp.io import read_capture


def message(path: Path) -> str:
    """Return the message of ``read_capture`` for ``path``, without the path at its beginning."""
    with pytest.raises(UserError) as error:
        read_capture(path, device="cpu")
    return str(error.value).removeprefix(f"{path}: ")


@pytest.mark.parametrize(
    ("name", "data", "part"),
    [
        ("photo.jpg", b"\xff\xd8\xff\xe0abcd", "a picture is not a capture; egs-warp from-photos makes"),
        ("misnamed.ply", b"\x89PNG\r\n\x1a\n", "a picture is not a capture; egs-warp from-photos"),
        ("walk.MP4", b"\0\0\0 ftypisom", "a video is not a capture; egs-warp from-photos"),
        ("torus.msh", b"$MeshFormat", "egs-warp animate takes such a file as the cage around its object"),
        ("garden.npz", b"PK\x03\x04", "a .npz file contains arrays, not a capture"),
        ("model.ckpt", b"PK\x03\x04", "export the Gaussians as .ply with the program that trained them"),
        ("scan.las", b"LASF", "a .las file is a point cloud, which has no Gaussians"),
        ("jump.egs", b"PK\x03\x04", "a bundle plays a finished run on a web page"),
        ("transforms.json", b"{}", "it contains camera poses, not a capture; egs-warp from-photos"),
        ("points3D.bin", b"\0\0", "it contains camera poses, not a capture; egs-warp from-photos"),
    ],
)
def test_the_message_says_what_the_file_is_and_names_a_command(
    name: str, data: bytes, part: str, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    assert part in message(path)


def test_folders(tmp_path: Path) -> None:
    """A folder of photos, or with photos below it, of captures, of meshes, and of a finished run."""
    photos = tmp_path / "data" / "images"
    photos.mkdir(parents=True)
    (photos / "0.JPG").write_bytes(b"\xff\xd8\xff")
    for folder in (photos, photos.parent):
        assert message(folder) == (
            f"the folder contains photos; egs-warp from-photos {folder} makes a capture and a film from them"
        )
    for name, start in (
        ("a.ply", "the folder is no capture, but contains a.ply; give one of these files"),
        ("thing.obj", "the folder contains a mesh, which has no Gaussians"),
        ("manifest.json", "the folder is a finished run; give the capture from which it was made; egs-warp view"),
    ):
        folder = tmp_path / name.partition(".")[0]
        folder.mkdir()
        (folder / name).touch()
        assert message(folder).startswith(start)
    (folder / "trajectory.npz").write_bytes(b"PK\x03\x04")
    assert message(folder / "trajectory.npz").startswith("it is a file of a finished run; give the capture")
