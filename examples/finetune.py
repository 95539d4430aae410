"""Interoperation with PyTorch: recover the lost colours of a pawn from images, by gradients of pixels with respect to
Gaussians.

The renderer is an ordinary differentiable torch function (``render_torch``), and ``finetune`` is a training loop around
it.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import warp as wp

import egs_warp as egs


def ring_of_cameras(cloud: egs.GaussianCloud, up: np.ndarray, *, count: int, size: int) -> list[egs.Camera]:
    """Return cameras around the object, slightly above its middle."""
    means = cloud.means.numpy().astype(float)
    low, high = np.percentile(means, [1, 99], axis=0)
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    side = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    side /= np.linalg.norm(side)
    front = np.cross(up, side)
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return [
        egs.Camera.look_at(
            middle + 3.2 * radius * (np.cos(a) * side + np.sin(a) * front + 0.35 * up),
            middle,
            up,
            width=size,
            height=size,
        )
        for a in angles
    ]


def brightness_gradient(cloud: egs.GaussianCloud, camera: egs.Camera) -> torch.Tensor:
    """Return the gradient (n, 3) of the image's mean brightness with respect to the Gaussians' means, computed by
    autograd."""
    means = torch.tensor(cloud.means.numpy(), requires_grad=True)
    rest = [torch.tensor(getattr(cloud, name).numpy()) for name in ("rotations", "log_scales", "opacity_logits", "sh")]
    rotations, log_scales, opacity_logits, sh = rest
    egs.render_torch(means, rotations, log_scales, opacity_logits, sh, camera).colour.mean().backward()
    assert means.grad is not None
    return means.grad


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/finetune"))
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    egs.use_device(arguments.device)
    if arguments.steps < 1 or not 16 <= arguments.size <= 4096:
        raise egs.UserError("give --steps of at least 1 and a --size from 16 to 4096 pixels")
    egs.writable_folder(arguments.out)

    built_in = egs.scene("pawn", device=arguments.device)
    cameras = ring_of_cameras(built_in.object, built_in.plane.normal, count=8, size=arguments.size)
    views = egs.render_views(built_in.object, cameras)
    grey = replace(built_in.object, sh=wp.zeros_like(built_in.object.sh))
    print(f"largest brightness gradient of a mean: {float(brightness_gradient(grey, cameras[0]).abs().max()):.2e}")
    result = egs.finetune(
        grey, views, options=egs.FinetuneOptions(iterations=arguments.steps, rates=egs.LearningRates(sh_band_0=2e-2))
    )

    pictures = {
        "original": built_in.object,
        "without colours": grey,
        f"after {arguments.steps} steps": result.cloud,
    }
    frames = [egs.render_gaussians(cloud, cameras[0]).colour_srgb8() for cloud in pictures.values()]
    egs.write_png(arguments.out / "finetune.png", egs.contact_sheet(frames, 3, list(pictures)))
    for label, cloud in pictures.items():
        quality = np.mean(
            [egs.psnr(np.clip(egs.render_gaussians(cloud, v.camera).colour.numpy(), 0, 1), v.image) for v in views]
        )
        print(f"{label:>18}: {quality:6.2f} dB")
    print(f"wrote finetune.png to {arguments.out}")


if __name__ == "__main__":
    with egs.one_line_errors("finetune.py"):
        main()
