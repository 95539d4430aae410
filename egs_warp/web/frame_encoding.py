"""Encoding of a state of a live body as a frame for the page."""

from __future__ import annotations

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.stepper import StepReport
from egs_warp.pipelines.captured_body import CapturedBody
from egs_warp.web.packets import Frame


def encode_frame(
    index: int, state: BodyState, report: StepReport | None, creature: CapturedBody, *, world_index: int = -1
) -> Frame:
    """Encode a state as a frame, with all curves of ``recording.CURVES`` except the momentum residual.

    Args:
        index: number of the frame.
        state: state at the end of the step.
        report: report of the step; None for the initial state.
        creature: creature of the state.
        world_index: index of the body in its world; -1 for a body alone.
    """
    body, muscles = creature.body, creature.muscles
    height = float(-body.gravity @ body.centre_of_mass(state.positions)) / float(np.linalg.norm(body.gravity))
    if report is None:
        curves = np.array([height / body.height, 0.0, 0.0, 0.0])
        return Frame(index, state.time, state.positions, np.zeros(muscles.segment_count), np.zeros((0, 9)), curves)
    contacts = report.contacts
    points = np.einsum("nw,nwi->ni", contacts.weights, state.positions[contacts.nodes])
    forces = np.einsum("na,nai->ni", report.forces, contacts.axes)
    external = report.forces[(contacts.faces >= 0) | (contacts.faces != -1 - world_index)]
    tangential_force = float(np.linalg.norm(external[:, 1:], axis=1).sum())
    friction_limit = creature.geometry.friction * float(external[:, 0].sum())
    return Frame(
        index,
        state.time,
        state.positions,
        report.activations / np.maximum(muscles.bounds, 1e-12),
        np.concatenate([points, contacts.axes[:, 0], forces], axis=1),
        np.array(
            [
                height / body.height,
                float(np.linalg.norm(forces.sum(axis=0))) / body.weight,
                tangential_force / max(friction_limit, 1e-9 * body.weight),
                report.min_gap / body.height,
            ]
        ),
    )
