"""Kernels of the mechanics compile for CUDA without a GPU: Warp's own compiler (NVRTC) needs no driver."""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path

import pytest
import warp as wp

import egs_warp.kernels.contact
import egs_warp.kernels.fem
import egs_warp.kernels.locomotion

PACKAGES = (egs_warp.kernels.contact, egs_warp.kernels.fem, egs_warp.kernels.locomotion)
ONLY_CPU = {"egs_warp.kernels.fem.quadratic_form", "egs_warp.kernels.fem.supernodal"}
"""Modules whose kernels are launched on a CPU only and do not compile for a GPU."""
ARCHITECTURE = 90
"""Compute capability 9.0: H100 and H200."""


def modules() -> list[str]:
    """Return the names of the modules with kernels that run on a GPU. Modules that contain only functions are
    omitted."""
    names = [found.name for one in PACKAGES for found in pkgutil.iter_modules(one.__path__, f"{one.__name__}.")]
    with_kernels = [name for name in names if any(isinstance(each, wp.Kernel) for each in vars_of(name))]
    return sorted(set(with_kernels) - ONLY_CPU)


def vars_of(name: str) -> list[object]:
    """Return the objects that the module ``name`` defines."""
    return [each for each in vars(importlib.import_module(name)).values() if getattr(each, "module", None) is not None]


@pytest.mark.slow
@pytest.mark.parametrize("name", modules())
def test_kernels_compile_for_cuda(name: str, tmp_path: Path) -> None:
    module = importlib.import_module(name)
    wp.compile_aot_module(module, arch=ARCHITECTURE, module_dir=str(tmp_path), use_ptx=True)
    assert [path.suffix for path in tmp_path.glob("*.ptx")] == [".ptx"]
