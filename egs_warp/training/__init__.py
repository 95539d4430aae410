"""Training through the renderer, with PyTorch: fine-tuning, and training from photographs.

Input: a cloud and views to match. Output: a cloud whose renders match the views. Fine-tuning can also minimise L_seg
(Eq. 21), and it trains inpainted floor. The kernels are in ``egs_warp/kernels/training``.
"""

import os
from importlib.util import find_spec

# OpenMP reads this variable when PyTorch is imported. By default, its threads wait for each other in busy loops; if
# other processes use the cores, too, this makes a training step 20 times slower.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def has_torch() -> bool:
    """Return True if PyTorch is installed."""
    return find_spec("torch") is not None
