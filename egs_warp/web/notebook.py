"""Widget for notebooks: the player of bundles in Jupyter, VS Code and Colab."""

from __future__ import annotations

import base64
import io
from functools import cache
from importlib import import_module, resources
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from egs_warp.deformation.deformer import Deformer
from egs_warp.deformation.embedding import embed_gaussians
from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.installation import install_command
from egs_warp.io.bundle import bundle_file
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.pipelines.bundle import bundle_of, bundle_of_motion
from egs_warp.pipelines.creature import Creature
from egs_warp.pipelines.film import drawn_frames, split_deformer
from egs_warp.pipelines.finished_run import FinishedRun
from egs_warp.pipelines.shot import Shot
from egs_warp.pipelines.simulated_run import SimulatedRun
from egs_warp.web.feed import live_camera
from egs_warp.web.player import player_script
from egs_warp.web.recordings import SessionRecording

_SIDE = 480
"""Width of the widget and of its picture, pixels."""


def show(subject: SimulatedRun | Creature | Path | str) -> Any:
    """Return a widget that plays a motion, or shows a creature at rest, in a notebook (docs/guide/notebook.md).

    Args:
        subject: The result of ``simulate``, a creature, or the folder of a finished run.

    Returns:
        An ``anywidget.AnyWidget``. If a notebook cannot show widgets, it shows a picture instead.

    Raises:
        UserError: anywidget is not installed, the player is not built, or the folder has no finished run.
    """
    widget_class = _widget_class()
    if isinstance(subject, SimulatedRun):
        run, frames = subject.trajectory, subject.simulation.frames
        deformer, camera = split_deformer(subject), subject.camera(_SIDE)
        title = " \u2192 ".join(record.name for record in subject.sequence.done)
    elif isinstance(subject, Creature):
        run, frames = SessionRecording(subject, subject.start).trajectory(), np.zeros(1, int)
        deformer = Deformer(subject.cloud, embed_gaussians(subject.cloud, subject.cage.mesh))
        camera, title = live_camera(subject, size=_SIDE), "creature"
    else:
        finished = FinishedRun.read(Path(subject))
        picture = _picture(finished.deformer(), finished.trajectory, finished.steps, finished.creature.camera)
        return widget_class(bundle_file(bundle_of(finished)), picture, plays=len(finished.steps) > 1)
    bundle = bundle_of_motion(deformer, run, frames, camera, title=title)
    return widget_class(bundle_file(bundle), _picture(deformer, run, frames, camera), plays=len(frames) > 1)


def widget_module() -> str:
    """Return the source of the widget's JavaScript module: the player, and a function that adds it to a cell.

    Raises ``UserError`` if the player has not been built.
    """
    return player_script() + resources.files("egs_warp.web").joinpath("widget.js").read_text("utf-8")


def _picture(deformer: Deformer, run: Trajectory, frames: np.ndarray, camera: Camera) -> bytes:
    """Return the frame in the middle of ``frames`` as a PNG."""
    (frame,) = drawn_frames(deformer, run, frames[[len(frames) // 2]], [camera], Shot())
    stream = io.BytesIO()
    Image.fromarray(frame.picture()).save(stream, "PNG")
    return stream.getvalue()


@cache
def _widget_class() -> Any:
    try:
        anywidget, traitlets = import_module("anywidget"), import_module("traitlets")
    except ImportError as error:
        raise UserError(f"show: anywidget is not installed; {install_command('notebook')}") from error

    class PlayerWidget(anywidget.AnyWidget):
        """Widget that shows ``<egs-player>`` in the output of a cell."""

        _esm = widget_module()
        bundle = traitlets.Bytes(help="The file of the bundle.").tag(sync=True)
        plays = traitlets.Bool(help="True if there is a motion.").tag(sync=True)

        def __init__(self, bundle: bytes, picture: bytes, *, plays: bool) -> None:
            super().__init__(bundle=bundle, plays=plays, layout={"width": f"{_SIDE}px", "max_width": "100%"})
            self._picture = picture

        def _repr_mimebundle_(self, **kwargs: Any) -> Any:
            data, metadata = super()._repr_mimebundle_(**kwargs)
            # Representation for environments without widgets, such as a page that displays the saved notebook.
            return data | {"image/png": base64.b64encode(self._picture).decode()}, metadata

    return PlayerWidget
