"""Training through the renderer, with PyTorch: fine-tuning, photographs and what starts from them.

In: a cloud and views to match. Out: a cloud that matches them. The losses of L_seg (Eq. 21) and of the filled floor use
it.
"""

from importlib.util import find_spec


def has_torch() -> bool:
    """Whether training is possible."""
    return find_spec("torch") is not None
