"""Deformation of the Gaussians of several bodies into one cloud."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from egs_warp.deformation.deformer import DeformedGaussians, Deformer
from egs_warp.geometry.gaussians import ARRAYS, GaussianCloud, concatenate, with_degree
from egs_warp.launching import empty


class JointDeformer:
    """Deformer of several bodies, each with its own cage, into one cloud. Missing SH bands of a body are zero."""

    def __init__(self, deformers: Sequence[Deformer], *, fixed: GaussianCloud | None = None) -> None:
        """Concatenate the clouds of ``deformers`` and then the cloud ``fixed``, which does not move."""
        self._deformers = tuple(deformers)
        clouds = [*(deformer.rest for deformer in deformers), *([] if fixed is None else [fixed])]
        degree = max(cloud.sh_degree for cloud in clouds)
        self.rest = concatenate(*(_with_bands(cloud, degree) for cloud in clouds))
        """All Gaussians; those of each body are in the frame of its cage."""
        rest = self.rest
        self._deformed = DeformedGaussians(
            replace(rest, **{name: wp.clone(getattr(rest, name)) for name in ARRAYS if name != "opacity_logits"}),
            rotations=empty(rest.count, wp.vec4, rest.device),
        )
        self._deformed.rotations.fill_(wp.vec4(1.0, 0.0, 0.0, 0.0))

    def deform(self, poses: Sequence[np.ndarray]) -> DeformedGaussians:
        """Deform all bodies; ``poses`` contains the node positions (N, 3) of each body, m. The next call overwrites the
        result."""
        deformed, first = self._deformed, 0
        for deformer, positions in zip(self._deformers, poses, strict=True):
            part = deformer.deform(positions)
            for name in ("means", "rotations", "log_scales", "sh"):
                _copy_rows(getattr(deformed.cloud, name), getattr(part.cloud, name), first)
            _copy_rows(deformed.rotations, part.rotations, first)
            first += part.cloud.count
        return deformed


def _copy_rows(target: Any, source: wp.array, first: int) -> None:
    """Copy ``source`` into the rows of ``target`` that start at row ``first``."""
    rows = target[first : first + source.shape[0]]
    wp.copy(rows if rows.ndim == 1 else rows[:, : source.shape[1]], source)


def _with_bands(cloud: GaussianCloud, degree: int) -> GaussianCloud:
    """Return ``cloud`` with SH bands up to ``degree``; missing bands are zero."""
    sh = with_degree(cloud, degree).sh.numpy()
    missing = (degree + 1) ** 2 - (cloud.sh_degree + 1) ** 2
    if missing == 0:
        return cloud
    return replace(cloud, sh=wp.array(np.pad(sh, ((0, 0), (0, missing), (0, 0))), dtype=wp.vec3, device=cloud.device))
