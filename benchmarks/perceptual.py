"""LPIPS (Zhang et al. 2018, AlexNet) where the ``lpips`` package and the network's weights are on this machine;
nothing is fetched.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch


def lpips_distance() -> tuple[Callable[[np.ndarray, np.ndarray], float] | None, str | None]:
    """The distance of two pictures (H, W, 3), 0 to 1, and None; or None and the reason why it cannot be had."""
    try:
        import lpips  # pyright: ignore[reportMissingImports]
    except ImportError:
        return None, "the package lpips is not installed"
    folder = Path(torch.hub.get_dir()) / "checkpoints"
    if not list(folder.glob("alexnet-*.pth")):
        return None, f"the weights of AlexNet (alexnet-*.pth) are not in {folder.name} of torch's hub folder"
    network = lpips.LPIPS(net="alex", verbose=False)

    def distance(one: np.ndarray, other: np.ndarray) -> float:
        pair = [torch.as_tensor(2.0 * picture - 1.0).float().permute(2, 0, 1)[None] for picture in (one, other)]
        with torch.no_grad():
            return float(network(*pair))

    return distance, None
