"""Labels of Gaussians from masks: in closed form from votes and, where the votes are uncertain, from the labels of
neighbours."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.segmentation.clicks import Click, hits_among
from egs_warp.segmentation.graph_cut import SplatGraph
from egs_warp.segmentation.votes import Votes

_MIN_VISIBLE_SHARE = 0.02
"""Minimum visible share of a Gaussian in the masked views; below it, votes do not label the Gaussian."""
_SURE = 4.0
"""Vote, in pixels, at and above which a Gaussian has full confidence."""
_SMOOTHNESS = 0.3
"""Cost of a neighbour with a different label, relative to a unanimous vote with full confidence."""


def labels_of_votes(votes: Votes, *, background_bias: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the mask (n,) bool of Gaussians that the masks claim, and the mask (n,) bool of Gaussians that the masks
    do not show.

    The labels that reproduce the masks with the least error are the solution of a linear program over blending weights.
    Each Gaussian's term is independent and is minimised by the label with the larger of its two sums (FlashSplat, Shen
    et al. 2024): a Gaussian belongs to the object if its share is above (1 + bias) / 2. A ``background_bias`` (-1 to 1)
    above 0 makes the object smaller, and one below 0 makes it larger. Raises ``UserError`` if the masks claim nothing.
    """
    seen = votes.share_seen() >= _MIN_VISIBLE_SHARE
    claimed = seen & (votes.share_inside() > 0.5 * (1.0 + background_bias))
    if not claimed.any():
        raise UserError("object: no part of the capture is visible inside the masks; check masks and cameras")
    return claimed, ~seen


def smoothed_labels(
    cloud: GaussianCloud, votes: Votes, nodes: np.ndarray, clicks: Sequence[Click] = (), *, views: int = 1
) -> np.ndarray:
    """Return the labels (m,) bool of the Gaussians with the indices ``nodes`` (m,) of ``cloud``, computed by a minimum
    cut.

    The score of a node is its vote, or 0 if no view shows it; nodes that ``clicks`` hit have fixed labels. With several
    ``views`` the confidence grows with the square root of their number, because errors of independently drawn masks
    average out.
    """
    pixels = (votes.inside + votes.outside)[nodes]
    # Above full confidence, the score grows with the square root of the number of pixels, like the precision of a
    # count.
    confidence = np.minimum(pixels / _SURE, np.sqrt(np.maximum(pixels / _SURE, 1.0)))
    score = (2.0 * votes.share_inside()[nodes] - 1.0) * confidence * np.sqrt(views)
    score[votes.share_seen()[nodes] < _MIN_VISIBLE_SHARE] = 0.0
    on_object, off_object = (hits_among(nodes, clicks, inside=inside) for inside in (True, False))
    return SplatGraph.of(cloud, nodes).cut(score, on_object & ~off_object, off_object, smoothness=_SMOOTHNESS)
