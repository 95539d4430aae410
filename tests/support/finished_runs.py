"""Small run in the format of ``animate``, whose arrays can be corrupted without invalidating a checksum."""

from __future__ import annotations

import io
import json
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.geometry.camera import Camera
from egs_warp.pipelines.render_data import FILE, RenderData
from egs_warp.web.recording import Recording
from tests.support.captures import small_cloud
from tests.support.slides import slide


@cache
def finished_run() -> dict[str, bytes]:
    """Return the files, by name, of a run of 24 steps of a block that is thrown and struck."""
    slid = slide(struck=True)
    camera = Camera.look_at(np.array([3.0, 0.0, 1.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]), width=32, height=24)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        slid.trajectory().save(folder / "trajectory.npz")
        RenderData.of(small_cloud(), camera, slid.stepper.muscles).save(folder / FILE)
        (folder / "report.json").write_text(json.dumps({"source": "block", "motion": [{"name": "jump"}], "notes": []}))
        return {path.name: path.read_bytes() for path in folder.iterdir()}


def arrays_as_json(name: str) -> bytes:
    """Return the arrays of a file of the run as JSON, so that single values can be corrupted.

    Empty arrays are left out, because JSON does not store their shapes.
    """
    with np.load(io.BytesIO(finished_run()[name]), allow_pickle=False) as arrays:
        return json.dumps({key: arrays[key].tolist() for key in arrays.files if arrays[key].size}).encode()


def npz_of_json(data: bytes) -> bytes:
    """Convert JSON of arrays to an .npz file; data that are not such JSON are returned unchanged."""
    try:
        tree = json.loads(data)
        arrays = {key: _array(values) for key, values in tree.items() if key.isidentifier() and key != "file"}
    except (ValueError, AttributeError):
        return data
    packed = io.BytesIO()
    np.savez(packed, **arrays)  # pyright: ignore[reportArgumentType]
    return packed.getvalue()


def _array(values: Any) -> np.ndarray:
    try:
        array = np.asarray(values)
    except ValueError:
        # NumPy rejects rows with different lengths.
        return np.zeros(0)
    return np.asarray(str(values)[:100]) if array.dtype == object else array


def draw_run(path: Path) -> None:
    """Read the run in the folder of ``path`` as the page and the film renderer do."""
    run = Recording.read(path.parent)
    assert run.bytes()
    last = len(run.steps) - 1
    cloud = run.deformer().deform(run.trajectory.positions[run.steps[last]]).cloud
    assert np.isfinite(cloud.means.numpy()).all() and np.isfinite(cloud.log_scales.numpy()).all()
    assert all(np.isfinite(part).all() for part in (run.activations(last), *run.contacts(last)))
