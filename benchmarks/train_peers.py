"""gsplat's MCMC strategy on the photos of ``benchmarks/train.py``, with the defaults of its own trainer."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import warp as wp
from scipy.spatial import KDTree

from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.io.colmap import SparsePoints
from egs_warp.training.initial_cloud import middle_of
from egs_warp.training.metrics import ssim
from egs_warp.training.training_view import TrainingView

_RATES = {"means": 1.6e-4, "scales": 5e-3, "opacities": 5e-2, "quats": 1e-3, "sh0": 2.5e-3, "shN": 1.25e-4}
_FIRST_OPACITY, _FIRST_SCALE = 0.5, 0.1
_OPACITY_WEIGHT = _SCALE_WEIGHT = 0.01
_SSIM_WEIGHT = 0.2
_SH_EVERY = 1000
_RANDOM_POINTS, _RANDOM_EXTENT = 100_000, 3.0


@dataclass(frozen=True)
class PeerResult:
    """Result of a training by gsplat."""

    cloud: GaussianCloud
    seconds: float
    """Duration of the training loop in seconds."""


def has_gsplat() -> bool:
    """Return True if gsplat is installed and there is a GPU."""
    try:
        import gsplat  # noqa: F401  # type: ignore[import-not-found]
    except ImportError:
        return False
    return torch.cuda.is_available()


def train_with_gsplat(
    views: Sequence[TrainingView],
    points: SparsePoints | None,
    *,
    iterations: int,
    max_gaussians: int,
    sh_degree: int = 3,
    seed: int = 0,
    device: str = "cuda:0",
) -> PeerResult:
    """Train with gsplat 1.5.3, set up as in its ``simple_trainer.py mcmc``; only the cap of the strategy is changed.

    The world is scaled to the cameras. Training starts from triangulated points or a random cube, the SH degree rises
    by one every 1,000 steps, and the background is black. Photos with alpha are composited over a random colour in each
    step, as in our trainer. SSIM is ``metrics.ssim``, because fused_ssim is a separate package.
    """
    from gsplat import rasterization  # type: ignore[import-not-found]
    from gsplat.strategy import MCMCStrategy  # type: ignore[import-not-found]

    torch.manual_seed(seed)
    random = np.random.default_rng(seed)
    centres = np.array([view.camera.centre for view in views])
    middle = middle_of([view.camera for view in views])
    unit = float(np.median(np.linalg.norm(centres - middle, axis=1)))
    scaled = (centres - middle) / unit
    scene_scale = 1.1 * float(np.linalg.norm(scaled - scaled.mean(axis=0), axis=1).max())
    if points is None:
        positions = _RANDOM_EXTENT * scene_scale * random.uniform(-1, 1, (_RANDOM_POINTS, 3))
        colours = random.uniform(size=(_RANDOM_POINTS, 3))
    else:
        positions, colours = (points.positions - middle) / unit, points.colours
    near = KDTree(positions).query(positions, k=4)[0][:, 1:]
    size = np.log(np.maximum(np.sqrt(np.mean(near**2, axis=1)) * _FIRST_SCALE, 1e-9))
    sh = np.zeros((len(positions), (sh_degree + 1) ** 2, 3))
    sh[:, 0] = (colours - 0.5) / SH_BAND_0
    values = {
        "means": positions,
        "scales": np.repeat(size[:, None], 3, axis=1),
        "opacities": np.full(len(positions), np.log(_FIRST_OPACITY / (1 - _FIRST_OPACITY))),
        "quats": random.uniform(size=(len(positions), 4)),
        "sh0": sh[:, :1],
        "shN": sh[:, 1:],
    }
    params = torch.nn.ParameterDict(
        {name: torch.nn.Parameter(torch.tensor(v, dtype=torch.float32, device=device)) for name, v in values.items()}
    )
    rates = _RATES | {"means": _RATES["means"] * scene_scale}
    optimisers = {
        name: torch.optim.Adam([{"params": params[name], "lr": rates[name]}], eps=1e-15, fused=True) for name in params
    }
    decay = torch.optim.lr_scheduler.ExponentialLR(optimisers["means"], gamma=0.01 ** (1.0 / iterations))
    strategy = MCMCStrategy(cap_max=max_gaussians)
    strategy.check_sanity(params, optimisers)
    state = strategy.initialize_state()
    targets = [_Target.of(view, middle, unit, device) for view in views]
    torch.cuda.synchronize()
    began = time.perf_counter()
    queue: list[int] = []
    for step in range(iterations):
        queue = queue or random.permutation(len(views)).tolist()
        target = targets[queue.pop()]
        background = None if target.alpha is None else torch.rand((1, 3), device=device)
        colours, _, info = rasterization(
            means=params["means"],
            quats=params["quats"],
            scales=torch.exp(params["scales"]),
            opacities=torch.sigmoid(params["opacities"]),
            colors=torch.cat([params["sh0"], params["shN"]], 1),
            viewmats=target.pose,
            Ks=target.intrinsics,
            width=target.image.shape[1],
            height=target.image.shape[0],
            sh_degree=min(step // _SH_EVERY, sh_degree),
            near_plane=0.01,
            far_plane=1e10,
            packed=False,
            backgrounds=background,
        )
        picture, image = colours[0], target.image
        if background is not None and target.alpha is not None:
            image = image * target.alpha + background[0] * (1 - target.alpha)
        loss = (1 - _SSIM_WEIGHT) * (picture - image).abs().mean() + _SSIM_WEIGHT * (1 - ssim(picture, image))
        loss = loss + _OPACITY_WEIGHT * torch.sigmoid(params["opacities"]).mean()
        loss = loss + _SCALE_WEIGHT * torch.exp(params["scales"]).mean()
        loss.backward()
        for optimiser in optimisers.values():
            optimiser.step()
            optimiser.zero_grad(set_to_none=True)
        decay.step()
        strategy.step_post_backward(params, optimisers, state, step, info, lr=decay.get_last_lr()[0])
    torch.cuda.synchronize()
    seconds = time.perf_counter() - began
    done = {name: tensor.detach() for name, tensor in params.items()}
    cloud = GaussianCloud(
        means=wp.from_torch(
            (done["means"] * unit + torch.tensor(middle, device=device)).float().contiguous(), dtype=wp.vec3
        ),
        rotations=wp.from_torch(torch.nn.functional.normalize(done["quats"], dim=1).contiguous(), dtype=wp.vec4),
        log_scales=wp.from_torch((done["scales"] + float(np.log(unit))).contiguous(), dtype=wp.vec3),
        opacity_logits=wp.from_torch(done["opacities"].contiguous(), dtype=wp.float32),
        sh=wp.from_torch(torch.cat([done["sh0"], done["shN"]], 1).contiguous(), dtype=wp.vec3),
    )
    return PeerResult(cloud, seconds)


@dataclass(frozen=True)
class _Target:
    image: torch.Tensor
    alpha: torch.Tensor | None
    pose: torch.Tensor
    intrinsics: torch.Tensor

    @classmethod
    def of(cls, view: TrainingView, middle: np.ndarray, unit: float, device: str) -> _Target:
        camera = view.camera
        pose = np.eye(4)
        pose[:3, :3] = camera.rotation
        pose[:3, 3] = (camera.translation + camera.rotation @ middle) / unit
        intrinsics = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])

        def upload(array: np.ndarray) -> torch.Tensor:
            return torch.tensor(array, dtype=torch.float32, device=device)

        alpha = None if view.alpha is None else upload(view.alpha)[:, :, None]
        return cls(upload(view.image), alpha, upload(pose)[None], upload(intrinsics)[None])
