"""Cache of prepared scenes, so that the same object in the same scene is prepared only once.

The files are pickles in a folder of the user into which only this program writes.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.inpainting.inpainters import OnnxInpainter, TorchScriptInpainter
from egs_warp.io.atomic import atomic_write, writable_folder
from egs_warp.io.posed_images import PosedImage
from egs_warp.pipelines.prepare_scene import PreparedScene, SceneOptions
from egs_warp.pipelines.report import MECHANICS, versions
from egs_warp.segmentation.object_spec import ObjectSpec

CACHE = "EGS_WARP_CACHE"
"""Environment variable with the folder of the cache; if the variable is set but empty, nothing is cached."""
MAX_SCENES = 12
"""Maximum number of prepared objects in the cache; a new one replaces the least recently used one."""
_PACKAGES = (*MECHANICS, "torch", "opencv-python-headless", "scikit-image", "onnxruntime")
"""Packages on which a prepared scene depends."""


def cache_folder() -> Path | None:
    """Return the folder of the cache, which may not exist yet; None if caching is disabled."""
    given = os.environ.get(CACHE)
    if given is not None:
        return Path(given) / "scenes" if given else None
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "egs-warp" / "scenes"


def scene_key(
    cloud: GaussianCloud,
    spec: ObjectSpec,
    *,
    posed: Sequence[PosedImage],
    up: np.ndarray | None,
    plane: Plane | None,
    options: SceneOptions,
) -> str:
    """Return the SHA-256 of everything on which ``prepare_scene`` depends, including files and this package's sources.

    The arguments are those of ``prepare_scene``; ``posed`` are its cameras and photos.
    """
    photos = [(one.camera, one.lens, _digest(one.image), _digest(one.mask)) for one in posed]
    inpainter = options.inpainter
    network = _digest(inpainter.path) if isinstance(inpainter, OnnxInpainter | TorchScriptInpainter) else None
    content = _Hash()
    parts = (_source_digest(), versions(_PACKAGES), cloud, spec, photos, up, plane, options, options.method, network)
    pickle.Pickler(content, protocol=5).dump(parts)
    return content.sha256.hexdigest()


def read_scene(key: str) -> PreparedScene | None:
    """Return the scene with the given ``key`` from the cache; None if the cache does not contain it."""
    folder = cache_folder()
    if folder is None:
        return None
    path = folder / f"{key}.pickle"
    try:
        with open(path, "rb") as file:
            scene = pickle.load(file)
        os.utime(path)
    # A damaged pickle may raise any exception.
    except Exception:
        return None
    return scene if isinstance(scene, PreparedScene) else None


def write_scene(key: str, scene: PreparedScene) -> str | None:
    """Write a scene to the cache and remove the least recently used ones; return a note for the user if that fails."""
    folder = cache_folder()
    if folder is None:
        return None
    try:
        writable_folder(folder)
        folder.chmod(0o700)
        with atomic_write(folder / f"{key}.pickle") as temporary, open(temporary, "wb") as file:
            pickle.dump(scene, file, protocol=5)
        scenes = sorted(folder.glob("*.pickle"), key=lambda path: path.stat().st_mtime, reverse=True)
        for path in scenes[MAX_SCENES:]:
            path.unlink(missing_ok=True)
    except (UserError, OSError) as error:
        return f"the prepared scene is not cached ({error}); {CACHE} sets another folder"
    return None


class _Hash:
    """Writable file object that hashes the data written to it."""

    def __init__(self) -> None:
        self.sha256 = hashlib.sha256()

    def write(self, data: Any) -> int:
        self.sha256.update(data)
        return memoryview(data).nbytes


def _digest(path: Path | None) -> str | None:
    """Return the SHA-256 of a file; None if there is none or it cannot be read."""
    if path is None:
        return None
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return None


@cache
def _source_digest() -> str:
    """Return the SHA-256 of the package's sources, which may change without a change of the version number."""
    root, content = Path(__file__).parents[1], hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        content.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return content.hexdigest()
