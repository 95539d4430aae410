"""Parameters of a cloud under training, as PyTorch tensors."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
import warp as wp

from egs_warp.geometry.gaussians import GaussianCloud

MIN_LOG_SCALE = -10.0
"""Minimum log scale: scales are at least e^-10, as in the paper."""


@dataclass(frozen=True)
class GaussianTensors:
    """Parameters under training, as leaf tensors with the conventions of ``GaussianCloud``."""

    means: torch.Tensor
    """(n, 3) means, scene units."""
    rotations: torch.Tensor
    """(n, 4) quaternions, w x y z."""
    log_scales: torch.Tensor
    """(n, 3) natural logarithms of the standard deviations."""
    opacity_logits: torch.Tensor
    """(n,) logits of the opacities."""
    sh_band_0: torch.Tensor
    """(n, 1, 3) SH coefficients of band 0."""
    sh_rest: torch.Tensor
    """(n, K - 1, 3) SH coefficients of the higher bands."""


def tensors_of(cloud: GaussianCloud, device: str) -> dict[str, torch.Tensor]:
    """Return copies of the cloud's parameters as leaf tensors by name."""
    values = {
        "means": cloud.means.numpy(),
        "rotations": cloud.rotations.numpy(),
        "log_scales": np.maximum(cloud.log_scales.numpy(), MIN_LOG_SCALE),
        "opacity_logits": cloud.opacity_logits.numpy(),
        "sh_band_0": cloud.sh.numpy()[:, :1],
        "sh_rest": cloud.sh.numpy()[:, 1:],
    }
    assert set(values) == {f.name for f in fields(GaussianTensors)}
    return {name: torch.tensor(array, device=device, requires_grad=True) for name, array in values.items()}


def cloud_of(tensors: dict[str, torch.Tensor]) -> GaussianCloud:
    """Return a cloud with copies of the parameters and normalised quaternions."""
    detached = {name: tensor.detach() for name, tensor in tensors.items()}
    rotations = torch.nn.functional.normalize(detached["rotations"], dim=1)
    sh = torch.cat([detached["sh_band_0"], detached["sh_rest"]], dim=1)
    return GaussianCloud(
        means=wp.from_torch(detached["means"].clone(), dtype=wp.vec3),
        rotations=wp.from_torch(rotations, dtype=wp.vec4),
        log_scales=wp.from_torch(detached["log_scales"].clone(), dtype=wp.vec3),
        opacity_logits=wp.from_torch(detached["opacity_logits"].clone(), dtype=wp.float32),
        sh=wp.from_torch(sh.contiguous(), dtype=wp.vec3),
    )
