"""Cost of deforming a million Gaussians with SH of degree 3: seven points, covariance, SVD and SH rotation of each
one.

Aims: ``cuda_within_2x_copy`` (on a GPU, at most twice the time of copying the same number of bytes), ``cpu_5x_twin``
(on a CPU, at least 5 times as fast as vectorised PyTorch on the same number of threads).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import warp as wp

import mesh_scenes as scenes
from egs_warp.deformation.deformer import Deformer
from egs_warp.deformation.embedding import GaussianEmbedding, embed_gaussians
from egs_warp.geometry.gaussians import GaussianCloud
from harness import Table, flags, median_ms, report
from kernels import copy_kernel

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BYTES_READ = 12 + 16 + 12 + 4
"""Bytes of a Gaussian's mean, rotation, scales and tetrahedron. The nodes of the deformed cage stay in the cache and
are not counted."""
BYTES_READ_ACROSS = 6 * (4 + 4) + 3 * 4
"""Additional bytes of a Gaussian that extends into several tetrahedra: tetrahedron and inside fraction of each arm, and
smoothing length of each axis."""
BYTES_WRITTEN = 12 + 16 + 12 + 16
"""Bytes of a Gaussian's deformed mean, rotation and scales and of its colour rotation."""
BYTES_OF_COLOUR = 192 + 192
"""Bytes of a Gaussian's 16 SH coefficients, read and written."""


def random_cloud(count: int, seed: int, device: str) -> GaussianCloud:
    """Return random Gaussians of many sizes in the unit cube; the larger ones extend into several tetrahedra."""
    rng = np.random.default_rng(seed)
    return GaussianCloud.from_numpy(
        rng.uniform(0.0, 1.0, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.uniform(-7.0, -3.0, (count, 3)),
        rng.normal(size=count),
        rng.normal(size=(count, 16, 3)),
        device=device,
    )


def _basis_2(d: torch.Tensor) -> torch.Tensor:
    x, y, z = d.unbind(-1)
    c = 1.0925484305920792
    return torch.stack(
        [c * x * y, -c * y * z, 0.31539156525252005 * (2 * z * z - x * x - y * y), -c * x * z, c / 2 * (x * x - y * y)],
        -1,
    )


def _basis_3(d: torch.Tensor) -> torch.Tensor:
    x, y, z = d.unbind(-1)
    return torch.stack(
        [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
            0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ],
        -1,
    )


class TorchTwin:
    """The deformation of ``Deformer`` in PyTorch, vectorised over whole arrays."""

    def __init__(self, cloud: GaussianCloud, embedding: GaussianEmbedding) -> None:
        points = embedding.points
        self.nodes = wp.to_torch(points.nodes).long().reshape(-1, 7, 4)
        self.weights = wp.to_torch(points.weights).reshape(-1, 7, 4)
        self.arms = wp.to_torch(embedding.arms).double()
        q = wp.to_torch(cloud.rotations)
        w, x, y, z = q.unbind(1)
        self.axes = torch.stack(
            [
                torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1),
                torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1),
                torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1),
            ],
            1,
        )
        self.scales = wp.to_torch(cloud.log_scales).exp()
        self.sh = wp.to_torch(cloud.sh)
        directions = torch.nn.functional.normalize(torch.randn(7, 3, generator=torch.Generator().manual_seed(2)), dim=1)
        self.directions = directions.to(q.device)
        self.from_values_2 = torch.linalg.inv(_basis_2(self.directions[:5]))
        self.from_values_3 = torch.linalg.inv(_basis_3(self.directions))

    def deform(self, positions: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return means, covariance factor (rotation, scales) and colour for node positions (N, 3)."""
        ends = (self.weights[..., None] * positions[self.nodes]).sum(2)
        mean = ends[:, 0]
        plus = (ends[:, 1:4] - mean[:, None]) / self.arms[:, :3, None]
        minus = (mean[:, None] - ends[:, 4:7]) / self.arms[:, 3:, None]
        stretched = (0.5 * (plus + minus)).transpose(1, 2).float()
        u, _, v = torch.linalg.svd(stretched)
        carried = u @ v
        frame, scales, _ = torch.linalg.svd(stretched * self.scales[:, None])
        turn = carried @ self.axes.transpose(1, 2)
        colour = self.sh.clone()
        linear = torch.stack([-self.sh[:, 3], -self.sh[:, 1], self.sh[:, 2]], 1)
        linear = turn @ linear
        colour[:, 3], colour[:, 1], colour[:, 2] = -linear[:, 0], -linear[:, 1], linear[:, 2]
        back = self.directions @ turn
        colour[:, 4:9] = self.from_values_2 @ (_basis_2(back[:, :5]) @ self.sh[:, 4:9])
        colour[:, 9:16] = self.from_values_3 @ (_basis_3(back) @ self.sh[:, 9:16])
        # PyTorch sorts the singular values in descending order; the engine preserves the order of the axes.
        return mean.float(), frame, scales, colour


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = flags(__doc__, quick="200,000 Gaussians on a CPU, fewer repeats")
    parser.add_argument("--gaussians", type=int)
    options = parser.parse_args(arguments)
    device = wp.get_device(options.device)
    count = options.gaussians or (1_000_000 if device.is_cuda or not options.quick else 200_000)
    cage = scenes.box_cage(np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]), 7)
    cloud = random_cloud(count, options.seed, options.device)
    embedding = embed_gaussians(cloud, cage)
    deformer, twin = Deformer(cloud, embedding), TorchTwin(cloud, embedding)
    positions = wp.array(scenes.bend(cage.nodes), dtype=wp.vec3d, device=device)
    torch_positions = wp.to_torch(positions)
    ours, theirs = deformer.deform(positions).cloud, twin.deform(torch_positions)
    off = {
        "means": float((wp.to_torch(ours.means) - theirs[0]).abs().max()),
        "scales": float(
            (wp.to_torch(ours.log_scales).exp().sort(dim=1).values / theirs[2].sort(dim=1).values - 1).abs().median()
        ),
        "colour": float((wp.to_torch(ours.sh) - theirs[3]).abs().median()),
    }
    calls: dict[str, Callable[[], Any]] = {
        "deform": lambda: deformer.deform(positions),
        "torch_twin": lambda: twin.deform(torch_positions),
    }
    tets = embedding.points.tets.numpy().reshape(-1, 7)
    across = int((tets != tets[:, :1]).any(axis=1).sum())
    bytes_moved = count * (BYTES_READ + BYTES_WRITTEN + BYTES_OF_COLOUR) + across * BYTES_READ_ACROSS
    source = wp.zeros(bytes_moved // 32, dtype=wp.vec4, device=device)
    target = wp.empty_like(source)
    # Half of the copy's traffic is reads and half is writes, so the copy moves as many bytes as the deformation. The
    # faster of two copies is used.
    calls["copy"] = lambda: wp.copy(target, source)
    calls["copy_kernel"] = lambda: wp.launch(copy_kernel, len(source), inputs=[source], outputs=[target], device=device)
    if device.is_cuda:
        # A launch takes 20 us on the host; with graphs, only the time on the device is measured.
        for name in ("deform", "copy", "copy_kernel"):
            calls[name]()
            with wp.ScopedCapture(device=device) as capture:
                calls[name]()
            if capture.graph is not None:
                calls[f"{name}_in_graph"] = functools.partial(wp.capture_launch, capture.graph)
    times = median_ms(
        calls, repeats=5 if options.quick else 15, synchronise=lambda: wp.synchronize_device(device), warm_up=2
    )
    fastest = min(times["deform"], times.get("deform_in_graph", np.inf))
    copy = min(time for name, time in times.items() if name.startswith("copy"))
    row = {
        "gaussians": count,
        "nodes": len(cage.nodes),
        "tets": len(cage.tets),
        "in_one_tet": 1.0 - across / count,
        "milliseconds": times,
        "bytes": bytes_moved,
        "copy_gigabytes_per_second": bytes_moved / copy / 1e6,
        "times_copy": fastest / copy,
        "twin_over_ours": times["torch_twin"] / fastest,
        "difference_from_twin": off,
    }
    aims: dict[str, bool | None] = {
        "cuda_within_2x_copy": row["times_copy"] <= 2.0 if device.is_cuda else None,
        "cpu_5x_twin": None if device.is_cuda else row["twin_over_ours"] >= 5.0,
    }
    why = {name: f"cannot be measured on {device.name}" for name, value in aims.items() if value is None}
    print(f"{count} Gaussians on {device.name}")
    table = Table(call="<20", ms="10.3f")
    for name, ms in times.items():
        table.row(name, ms)
    print(f"{row['times_copy']:.2f} times the time of a copy, {row['twin_over_ours']:.1f} times as fast as PyTorch")
    print(f"difference from PyTorch: {off}")

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.barh(list(times), list(times.values()))
        axes.set_xlabel(f"ms for {count:,} Gaussians, {device.name}")

    report(
        options,
        [row],
        aims=aims,
        why_null=why,
        packages=["torch"],
        conditions={"torch_threads": torch.get_num_threads()},
        draw=draw,
        size=(5.0, 2.5),
    )


if __name__ == "__main__":
    main()
