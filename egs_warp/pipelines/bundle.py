"""Export of a finished run to one file: rest splats, cage and node positions. ``examples/read_bundle.py`` reads it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.deformation.deformer import MAX_STRETCH
from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import with_degree
from egs_warp.io.atomic import atomic_write
from egs_warp.io.run_folder import check_no_file_of_a_run
from egs_warp.kernels.deformation.cage_maps import RIGID
from egs_warp.locomotion.rollout import FRAME_RATE
from egs_warp.pipelines.export import chosen_frames
from egs_warp.pipelines.finished_run import FinishedRun

ENDING = ".npz"
_SCHEMA = 1


def export_bundle(run: FinishedRun, path: Path, *, every: int = 1, degree: int | None = None) -> None:
    """Write ``run`` to one .npz file (docs/guide/export.md).

    Args:
        run: The run to export.
        path: Name that ends in .npz.
        every: Export each ``every``-th frame at 60 Hz.
        degree: SH degree of the colours; None keeps that of the capture.

    Raises:
        UserError: ``path`` has another ending, or is a file of a run.
    """
    if path.suffix.lower() != ENDING:
        raise UserError(f"{path}: give a name that ends in {ENDING}")
    check_no_file_of_a_run(path)
    frames = chosen_frames(run, frame=None, every=every)
    t, splats, plan = run.trajectory, with_degree(run.creature.splats, degree), run.deformer().plan
    codes, shares = plan.mean_tets.numpy(), plan.inside_fractions.numpy()
    rigid = (codes < 0) & (shares[0] == float(RIGID))
    rows = np.flatnonzero((codes < 0) & ~rigid)
    arrays: dict[str, Any] = {
        "schema": np.int32(_SCHEMA),
        "fps": np.float64(FRAME_RATE / every),
        "means": splats.means.numpy(),
        "rotations": splats.rotations.numpy(),
        "log_scales": splats.log_scales.numpy(),
        "opacity_logits": splats.opacity_logits.numpy(),
        "sh": splats.sh.numpy(),
        "antialiased": np.bool_(splats.antialiased),
        "rest_nodes": t.rest_positions,
        "tets": t.tets.astype(np.int32),
        "nodes": t.positions[run.steps[frames]].astype(np.float32),
        "mean_tets": np.where(codes < 0, -1 - codes, codes),
        "rigid": rigid,
        "arm_rows": rows.astype(np.int32),
        "arm_tets": plan.end_tets.numpy()[:, rows],
        "arm_shares": shares[:, rows],
        "arm_bulges": plan.smoothing_lengths.numpy()[:, rows],
        "max_stretch": np.float64(MAX_STRETCH),
        "body_axes": t.body_axes,
        "body_origin": t.body_origin,
        "metres_per_unit": np.float64(t.metres_per_unit),
    }
    with atomic_write(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, **arrays)
