"""Votes by blending weights compared with a slow reference, and masks of a wrong size."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.render import render_gaussians
from egs_warp.segmentation.votes import MaskedView, blending_votes

SH_0 = 0.28209479177387814


def random_cloud(device: str, count: int = 40) -> GaussianCloud:
    random = np.random.default_rng(5)
    return GaussianCloud.from_numpy(
        random.uniform(-0.8, 0.8, (count, 3)),
        random.normal(size=(count, 4)),
        random.uniform(-3.0, -1.5, (count, 3)),
        random.uniform(-1.0, 3.0, count),
        random.normal(size=(count, 4, 3)),
        device=device,
    )


def camera() -> Camera:
    return Camera.look_at(np.array([0.3, -3.0, 0.8]), np.zeros(3), np.array([0.0, 0.0, 1.0]), width=56, height=40)


def test_votes_are_the_blending_weights(device: str) -> None:
    """The votes of a Gaussian equal the sums of its blending weights, which are rendered with it white and all others
    black."""
    cloud, view = random_cloud(device), camera()
    mask = np.zeros((view.height, view.width), bool)
    mask[10:25, 20:45] = True
    votes = blending_votes(cloud, [MaskedView(view, mask), MaskedView(view, ~mask)])
    for chosen in range(0, cloud.count, 3):
        sh = np.full((cloud.count, 1, 3), -0.5 / SH_0)
        sh[chosen] = 0.5 / SH_0
        painted = GaussianCloud.from_numpy(
            *(getattr(cloud, name).numpy() for name in ("means", "rotations", "log_scales", "opacity_logits")),
            sh=sh,
            device=device,
        )
        weight = render_gaussians(painted, view, background=(0.0, 0.0, 0.0)).colour.numpy()[..., 0].astype(np.float64)
        # The second view exchanges inside and outside.
        assert votes.inside[chosen] == pytest.approx(weight.sum(), rel=1e-4, abs=1e-4)
        assert votes.outside[chosen] == pytest.approx(weight.sum(), rel=1e-4, abs=1e-4)
    one = blending_votes(cloud, [MaskedView(view, mask)])
    share = one.share_inside()
    assert ((share >= 0.0) & (share <= 1.0)).all()
    assert share.min() < 0.1 and share.max() > 0.9


def test_a_hidden_gaussian_has_little_weight(device: str) -> None:
    """If two equal Gaussians are one behind the other, only the front one is almost completely visible."""
    cloud = GaussianCloud.from_numpy(
        np.array([[0.0, -0.5, 0.0], [0.0, 0.5, 0.0], [0.7, 0.0, 0.0]]),
        np.tile([1.0, 0.0, 0.0, 0.0], (3, 1)),
        np.full((3, 3), -2.0),
        np.array([6.0, 6.0, 6.0]),
        np.zeros((3, 1, 3)),
        device=device,
    )
    view = Camera.look_at(np.array([0.0, -3.0, 0.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]), width=64, height=64)
    seen = blending_votes(cloud, [MaskedView(view, np.ones((64, 64), bool))]).share_seen()
    assert seen[0] > 0.9 and seen[2] > 0.9
    assert seen[1] < 0.4


def test_a_mask_of_another_size_is_refused() -> None:
    view = MaskedView(camera(), np.ones((10, 10), bool), "photo7.png")
    with pytest.raises(UserError, match=r"photo7\.png: the mask has 10 x 10 pixels, but its camera has 56 x 40"):
        blending_votes(random_cloud("cpu"), [view])


def test_gaussians_outside_the_image_have_no_weight() -> None:
    """Gaussians behind the camera or far to the side have zero weight, also without occlusion. A Gaussian in a single
    tile has weight."""
    means = np.array([[0.0, 0.0, 0.0], [0.0, -9.0, 0.0], [40.0, 0.0, 0.0]])
    cloud = GaussianCloud.from_numpy(
        means, np.tile([1.0, 0, 0, 0], (3, 1)), np.full((3, 3), -4.0), np.full(3, 2.0), np.zeros((3, 1, 3))
    )
    view = camera()
    votes = blending_votes(cloud, [MaskedView(view, np.ones((view.height, view.width), bool))])
    assert votes.unhidden[0] > 0.0 and votes.unhidden[1] == votes.unhidden[2] == 0.0
    assert votes.unhidden[0] == pytest.approx(votes.inside[0], rel=0.05), "alone, nothing hides it"
