"""Training through the renderer, with PyTorch: fine-tuning, and training from photographs.

Input: a cloud and views to match. Output: a cloud whose renders match the views. The fine-tuning also minimises L_seg
(Eq. 21) and trains inpainted floor. The kernels are in ``egs_warp/kernels/training``.
"""

from importlib.util import find_spec


def has_torch() -> bool:
    """Return True if PyTorch is installed."""
    return find_spec("torch") is not None
