"""Which Gaussians masks mean: a closed form over their votes, and where these are unsure, what their neighbours are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.segmentation.clicks import Click, hits_among
from egs_warp.segmentation.graph_cut import SplatGraph
from egs_warp.segmentation.votes import Votes

_SEEN = 0.02
"""A Gaussian of which less than this share shows in the masked views has no say in whether it belongs to the object."""
_SURE = 4.0
"""Pixels: who votes with as many is as sure as the shares say."""
_SMOOTHNESS = 0.3
"""Of a vote that all pixels agree in: what it costs that a neighbour is labelled otherwise."""


def labels_of_votes(votes: Votes, *, background_bias: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """(n,) bool: Gaussians that the masks claim, and (n,) bool: those that they do not show.

    The labels that paint the masks with the least error are a linear programme over blending weights, and as each
    Gaussian's term stands alone, it is solved by the larger of its two sums (FlashSplat, Shen et al. 2024):
    the object's where its share is above (1 + bias) / 2. ``background_bias``, -1 to 1, makes the object leaner above 0
    and fuller below. Raises ``UserError`` where the masks claim nothing.
    """
    seen = votes.share_seen() >= _SEEN
    wanted = seen & (votes.share_inside() > 0.5 * (1.0 + background_bias))
    if not wanted.any():
        raise UserError("object: nothing of the capture shows inside the masks; check masks and cameras")
    return wanted, ~seen


def smoothed_labels(
    cloud: GaussianCloud, votes: Votes, nodes: np.ndarray, clicks: Sequence[Click] = (), *, views: int = 1
) -> np.ndarray:
    """(m,) bool labels of the ``nodes`` (m,), indices of ``cloud``: each leans as its votes say, one that no view shows
    not at all; what ``clicks`` hit is sure; and the cut between the two labels is the least one.

    What several ``views`` say is surer by their number's root, as errors of masks drawn one by one average out.
    """
    pixels = (votes.inside + votes.outside)[nodes]
    # Beyond that it is surer by the root of their number, as of anything counted.
    sure = np.minimum(pixels / _SURE, np.sqrt(np.maximum(pixels / _SURE, 1.0)))
    leaning = (2.0 * votes.share_inside()[nodes] - 1.0) * sure * np.sqrt(views)
    leaning[votes.share_seen()[nodes] < _SEEN] = 0.0
    held, dropped = (hits_among(nodes, clicks, inside=inside) for inside in (True, False))
    return SplatGraph.of(cloud, nodes).cut(leaning, held & ~dropped, dropped, smoothness=_SMOOTHNESS)
