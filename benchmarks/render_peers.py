"""The other renderers of ``benchmarks/render.py``, with a common signature, and compositing in plain PyTorch."""

from __future__ import annotations

import importlib
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.render.autograd import render_torch
from egs_warp.render.projection import ProjectedGaussians
from egs_warp.render.tiles import TileLists


@dataclass(frozen=True)
class Scene:
    """Gaussians in the form that the other renderers accept: leaf tensors of activated values."""

    means: torch.Tensor
    rotations: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    colours: torch.Tensor


def garden_scene(points: dict[str, np.ndarray], *, grid: int, seed: int, device: str) -> Scene:
    """Build the scene of gsplat's own benchmark.

    Points within 2 of the origin become random Gaussians, repeated grid x grid times at spacing 4.
    """
    means, colours = points["means3d"], points["colors"] / 255.0
    inside = (np.abs(means) <= 2.0).all(axis=1)
    steps = np.arange(-(grid // 2), grid // 2 + 1)
    shifts = np.stack(np.meshgrid(steps, steps, [0], indexing="ij"), -1).reshape(-1, 3) * 4.0
    means = (means[None, inside] + shifts[:, None]).reshape(-1, 3)
    count = len(means)
    random = torch.Generator(device="cpu").manual_seed(seed)

    def leaf(values: torch.Tensor) -> torch.Tensor:
        return values.float().to(device).contiguous().requires_grad_()

    return Scene(
        means=leaf(torch.from_numpy(means)),
        rotations=leaf(torch.nn.functional.normalize(torch.randn((count, 4), generator=random), dim=-1)),
        scales=leaf(torch.rand((count, 3), generator=random) * (0.02 - 1e-4) + 1e-4),
        opacities=leaf(torch.rand(count, generator=random)),
        colours=leaf(torch.from_numpy(np.tile(colours[inside], (grid * grid, 1)))),
    )


def cloud_of(scene: Scene) -> GaussianCloud:
    """Wrap tensors in the parameters of captures as a cloud, without a copy."""
    return GaussianCloud(
        means=wp.from_torch(scene.means.detach(), dtype=wp.vec3),
        rotations=wp.from_torch(scene.rotations.detach(), dtype=wp.vec4),
        log_scales=wp.from_torch(scene.scales.detach(), dtype=wp.vec3),
        opacity_logits=wp.from_torch(scene.opacities.detach(), dtype=wp.float32),
        sh=wp.from_torch(scene.colours.detach(), dtype=wp.vec3),
    )


def garden_camera(points: dict[str, np.ndarray], *, width: int, height: int, number: int = 0) -> Camera:
    """Return one of the garden's three cameras, its image resampled to ``width`` x ``height``."""
    view, k = points["viewmats"][number].astype(float), points["Ks"][number].astype(float)
    x, y = width / float(points["width"]), height / float(points["height"])
    return Camera(width, height, k[0, 0] * x, k[1, 1] * y, k[0, 2] * x, k[1, 2] * y, view[:3, :3], view[:3, 3])


Renderer = Callable[[Scene, Camera], torch.Tensor]


def ours(scene: Scene, camera: Camera) -> torch.Tensor:
    """Render ``scene`` as (H, W, 3). ``ours_scene`` must have converted the scene before, so that the conversion is not
    timed."""
    return render_torch(
        scene.means, scene.rotations, scene.scales, scene.opacities, scene.colours, camera, background=(0.0, 0.0, 0.0)
    ).colour


def ours_scene(scene: Scene) -> Scene:
    """Return the same Gaussians as parameters of captures: log scales, opacity logits, SH of degree 0."""
    return Scene(
        means=scene.means.detach().clone().requires_grad_(),
        rotations=scene.rotations.detach().clone().requires_grad_(),
        scales=scene.scales.detach().log().requires_grad_(),
        opacities=torch.logit(scene.opacities.detach().double(), eps=1e-7).float().requires_grad_(),
        colours=((scene.colours.detach() - 0.5) / SH_BAND_0)[:, None].contiguous().requires_grad_(),
    )


def _once_per_camera(make: Callable[[Camera], Any]) -> Callable[[Camera], Any]:
    """Cache the results of ``make`` by camera, because the other renderers take GPU tensors, whose creation must not be
    timed."""
    cache: dict[int, tuple[Camera, Any]] = {}

    def get(camera: Camera) -> Any:
        if id(camera) not in cache:
            # The camera itself is stored too, so that its id, the key, is not reused.
            cache[id(camera)] = (camera, make(camera))
        return cache[id(camera)][1]

    return get


def gsplat_matrices(camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the pose (1, 4, 4) and the intrinsics (1, 3, 3) on the GPU."""
    view = torch.eye(4)
    view[:3, :3] = torch.as_tensor(camera.rotation)
    view[:3, 3] = torch.as_tensor(camera.translation)
    k = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    return view[None].float().cuda(), k[None].float().cuda()


def gsplat_renderer(*, packed: bool) -> Renderer:
    """Return the renderer of gsplat; raises ImportError if gsplat is not installed."""
    from gsplat.rendering import rasterization

    matrices_of = _once_per_camera(gsplat_matrices)

    def draw(scene: Scene, camera: Camera) -> torch.Tensor:
        colours, _, _ = rasterization(
            *(scene.means, scene.rotations, scene.scales, scene.opacities, scene.colours),
            *(*matrices_of(camera), camera.width, camera.height),
            packed=packed,
        )
        return colours[0]

    return draw


def gswarp_renderer() -> Renderer:
    """Return the renderer of gswarp 1.1; raises ImportError if it is not installed."""
    from gswarp import GaussianRasterizationSettings, GaussianRasterizer

    def settings(camera: Camera) -> GaussianRasterizationSettings:
        device = "cuda"
        view = torch.eye(4)
        view[:3, :3] = torch.as_tensor(camera.rotation)
        view[:3, 3] = torch.as_tensor(camera.translation)
        near, far = 0.01, 100.0
        projection = torch.zeros(4, 4)
        projection[0, 0], projection[1, 1] = 2 * camera.fx / camera.width, 2 * camera.fy / camera.height
        projection[0, 2] = 2 * camera.cx / camera.width - 1
        projection[1, 2] = 2 * camera.cy / camera.height - 1
        projection[2, 2], projection[2, 3], projection[3, 2] = far / (far - near), -far * near / (far - near), 1.0
        return GaussianRasterizationSettings(
            image_height=camera.height,
            image_width=camera.width,
            tanfovx=camera.width / (2 * camera.fx),
            tanfovy=camera.height / (2 * camera.fy),
            bg=torch.zeros(3, device=device),
            scale_modifier=1.0,
            viewmatrix=view.T.contiguous().to(device),
            projmatrix=(projection @ view).T.contiguous().to(device),
            sh_degree=0,
            campos=torch.as_tensor(camera.centre).float().to(device),
            prefiltered=False,
            auto_tune_verbose=False,
        )

    settings_of = _once_per_camera(settings)

    def draw(scene: Scene, camera: Camera) -> torch.Tensor:
        colour, _, _ = GaussianRasterizer(settings_of(camera))(
            means3D=scene.means,
            means2D=torch.zeros_like(scene.means, requires_grad=scene.means.requires_grad),
            opacities=scene.opacities[:, None],
            colors_precomp=scene.colours,
            scales=scene.scales,
            rotations=scene.rotations,
        )
        return colour.permute(1, 2, 0)

    return draw


def cpu_baselines(scene: Scene, camera: Camera) -> dict[str, dict[str, Any]]:
    """Run each renderer on PyPI that claims CPU support.

    None works. JAX 0.10.2 rejects the Warp calls of splax 0.2.3 on a CPU ("JaxCallableGraphMode.WARP is not supported
    for JAX CPU FFI calls"). The import of taichi-splatting 0.13 compiles CUDA code ("CUDA_HOME environment variable is
    not set"), here on taichi 1.7.4, because the taichi-nightly that it requires is in no index.

    Args:
        scene: Gaussians in the parameters of captures (``ours_scene``).

    Returns:
        milliseconds by name, or None and the error.
    """
    outcomes: dict[str, dict[str, Any]] = {}
    for name, attempt in (("splax", _splax_ms), ("taichi-splatting", _taichi_splatting_ms)):
        try:
            outcomes[name] = {"ms": attempt(scene, camera), "outcome": "runs"}
        # A third-party package may raise anything; the error is the result.
        except Exception as error:
            reason = str(error).strip().splitlines()
            outcomes[name] = {"ms": None, "outcome": f"{type(error).__name__}: {reason[0] if reason else ''}"}
    return outcomes


def _splax_ms(scene: Scene, camera: Camera) -> float:
    import jax.numpy as jnp  # pyright: ignore[reportMissingImports]
    import splax  # pyright: ignore[reportMissingImports]

    names = ("means", "scales", "rotations", "colours", "opacities")
    arrays = [jnp.asarray(getattr(scene, name).detach().numpy()) for name in names]
    view = np.eye(4, dtype=np.float32)
    view[:3, :3], view[:3, 3] = camera.rotation, camera.translation

    times = []
    for _ in range(4):
        start = time.perf_counter()
        splax.render(
            *arrays,
            viewmat=jnp.asarray(view),
            background=jnp.zeros(3),
            img_shape=(camera.height, camera.width),
            f=(camera.fx, camera.fy),
            c=(camera.cx, camera.cy),
        )[0].block_until_ready()
        times.append((time.perf_counter() - start) * 1e3)
    return statistics.median(times[1:])


def _taichi_splatting_ms(scene: Scene, camera: Camera) -> float | None:
    """Return None; the package cannot be imported on a CPU."""
    importlib.import_module("taichi_splatting")
    return None


def composite_in_torch(projected: ProjectedGaussians, lists: TileLists, camera: Camera) -> torch.Tensor:
    """Blend the tiles to an image (H, W, 3) in plain PyTorch. The tile lists are the same as ours, so culling is the
    same.

    Tiles with lists of similar length share a batch (tiles, 256 pixels, splats), which gives PyTorch large operations
    with little padding.
    """
    ellipse, falloff, colour = (
        wp.to_torch(array) for array in (projected.ellipse, projected.falloff, projected.colour_depth)
    )
    order = wp.to_torch(lists.gaussian_from_intersection)[: projected.slot_count].long()
    start = wp.to_torch(lists.tile_start).long()
    lengths = start[1:] - start[:-1]
    columns = -(-camera.width // 16)
    rows = -(-camera.height // 16)
    pixel = torch.arange(256)
    tiles = torch.zeros((columns * rows, 256, 3))
    by_length = torch.argsort(lengths)
    by_length = by_length[lengths[by_length] > 0]
    first = 0
    while first < len(by_length):
        # Batches of about 100,000 pixel-splat pairs fit into the cache; larger batches take longer per pair.
        longest = int(lengths[by_length[first]])
        size = max(1, 100_000 // (256 * max(longest, 1)))
        batch = by_length[first : first + size]
        first += size
        longest = int(lengths[batch].max())
        slot = torch.arange(longest)
        real = slot < lengths[batch, None]
        splat = order[torch.where(real, start[batch, None] + slot, 0)]
        e, f = ellipse[splat], falloff[splat]
        x = (batch % columns * 16)[:, None] + pixel % 16 + 0.5
        y = (torch.div(batch, columns, rounding_mode="floor") * 16)[:, None] + torch.div(
            pixel, 16, rounding_mode="floor"
        )
        dy = y[:, :, None] + 0.5 - e[:, None, :, 1]
        u = x[:, :, None] - e[:, None, :, 0] + e[:, None, :, 3] * dy
        alpha = torch.exp(f[:, None, :, 1] - f[:, None, :, 0] * dy * dy - e[:, None, :, 2] * u * u).clamp_max(0.999)
        alpha = torch.where((alpha >= 1 / 255) & real[:, None], alpha, 0.0)
        after = torch.cumprod(1 - alpha, dim=2)
        weight = alpha * torch.cat([torch.ones_like(after[:, :, :1]), after[:, :, :-1]], dim=2) * (after > 1e-4)
        tiles[batch] = torch.einsum("tps,tsc->tpc", weight, colour[splat][:, :, :3])
    picture = tiles.reshape(rows, columns, 16, 16, 3).permute(0, 2, 1, 3, 4).reshape(rows * 16, columns * 16, 3)
    return picture[: camera.height, : camera.width]
