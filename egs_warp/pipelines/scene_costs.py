"""Expected processor times of the stages of preparing a scene, computed from the sizes of the scene.

The constants were measured for koala, fox and narcissus (50,000 to 101,000 Gaussians) on one core of a CPU. Progress
bars use only the ratios of the times, which differ less between machines than the times themselves.
"""

from __future__ import annotations

from egs_warp.inpainting.holes import Hole
from egs_warp.inpainting.inpaint import inpaint_cost

_PLANE_COST, _PLANE_COST_PER_GAUSSIAN = 2.4, 1.7e-5
"""Plane search and segmentation on the plane: constant part, s, and part per Gaussian, s. Measured in total: 3.1, 3.5
and 4.1 s."""
_GROUND_COST = 5.0
"""Measurement of the ground, s; measured: 6.4, 3.5 and 6.7 s."""
_TORCH_COST = 2.5
"""Import of PyTorch and its first training step, s."""
_CLEARING_COST = 2.0
"""Clearing of the plane without training, plus the estimate of the light, s."""
_STEP_COST, _STEP_COST_PER_GAUSSIAN = 0.014, 2.3e-7
"""Training step at the plane: constant part, s, and part per Gaussian of the object, s. Measured in total: 0.018, 0.023
and 0.031 s."""
_OBJECT_FRACTION = 0.7
"""Assumed fraction of the Gaussians that belong to the object while the object is not known; measured: 0.56, 0.89 and
0.73."""


def scene_costs(
    gaussian_count: int,
    *,
    has_ground: bool,
    clearing_steps: int,
    inpainting_steps: int | None,
    object_count: int | None = None,
    hole: Hole | None = None,
) -> dict[str, float]:
    """Return the expected processor time of each stage of ``prepare_scene``, s, in the order of the stages.

    Args:
        gaussian_count: Number of Gaussians of the capture.
        has_ground: True if the ground is measured.
        clearing_steps: Number of training steps at the plane; 0 if there is no training.
        inpainting_steps: Number of training steps of the inpainting; None if there is no inpainting.
        object_count: Number of Gaussians of the object; None if it is not known yet.
        hole: Hole in the floor; None if it is not known yet.
    """
    objects = _OBJECT_FRACTION * gaussian_count if object_count is None else object_count
    costs = {"plane": _PLANE_COST + _PLANE_COST_PER_GAUSSIAN * gaussian_count}
    if has_ground:
        costs["ground"] = _GROUND_COST
    costs["segment"] = _CLEARING_COST + (_STEP_COST + _STEP_COST_PER_GAUSSIAN * objects) * clearing_steps
    if inpainting_steps is not None:
        costs["inpaint"] = inpaint_cost(hole, steps=inpainting_steps)
    training = "segment" if clearing_steps > 0 else "inpaint"
    if clearing_steps > 0 or inpainting_steps:
        costs[training] += _TORCH_COST
    return costs
