"""Steppers with matrices in device memory: on a GPU, or on a CPU with the kernels for GPUs."""

from __future__ import annotations

from dataclasses import replace

import pytest

from egs_warp.fem.elasticity import ElasticAssembly
from egs_warp.fem.tiled_cholesky import TiledCholesky
from egs_warp.fem.warp_elasticity import WarpElasticity
from egs_warp.locomotion.settings import LocomotionSettings
from egs_warp.locomotion.stepper import LocomotionStepper
from egs_warp.pipelines.creature import Creature


def on_device(
    creature: Creature, device: str, patch: pytest.MonkeyPatch, settings: LocomotionSettings | None = None
) -> LocomotionStepper:
    """Return a stepper of the ``creature``'s body and muscles on ``device``."""
    patch.setattr(ElasticAssembly, "new_solver", lambda assembly: TiledCholesky(assembly.upper_pattern, device=device))
    patch.setattr("egs_warp.fem.elasticity.SimdElasticity", WarpElasticity)
    mesh, material = creature.body.assembly.mesh, creature.body.assembly.material
    body = replace(creature.body, assembly=ElasticAssembly(mesh, material, device=device))
    return LocomotionStepper(body, creature.muscles, creature.geometry, settings=settings, device=device)
