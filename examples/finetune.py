"""Torch interop: a pawn that lost its colours gets them back from pictures, pixels to Gaussians with gradients all the
way.

The renderer is an ordinary differentiable torch function (``render_torch``); ``finetune`` is the loop around it.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import warp as wp

from egs_warp.assets import pawn
from egs_warp.commands.flags import check_device
from egs_warp.errors import UserError, one_line_errors
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io.atomic import writable_folder
from egs_warp.io.video import contact_sheet, write_png
from egs_warp.render import render
from egs_warp.render.autograd import render_torch
from egs_warp.training.finetune import FinetuneOptions, Rates, finetune, views_of_capture
from egs_warp.training.likeness import psnr


def ring_of_cameras(cloud: GaussianCloud, up: np.ndarray, *, count: int, size: int) -> list[Camera]:
    """Cameras around the object, a little above its middle."""
    means = cloud.means.numpy().astype(float)
    low, high = np.percentile(means, [1, 99], axis=0)
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    side = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    side /= np.linalg.norm(side)
    front = np.cross(up, side)
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return [
        Camera.look_at(
            middle + 3.2 * radius * (np.cos(a) * side + np.sin(a) * front + 0.35 * up),
            middle,
            up,
            width=size,
            height=size,
        )
        for a in angles
    ]


def brightness_gradient(cloud: GaussianCloud, camera: Camera) -> torch.Tensor:
    """(n, 3): by how much the picture gets brighter as each Gaussian moves: autograd through the renderer."""
    means = torch.tensor(cloud.means.numpy(), requires_grad=True)
    rest = [torch.tensor(getattr(cloud, name).numpy()) for name in ("rotations", "log_scales", "opacity_logits", "sh")]
    rotations, log_scales, opacity_logits, sh = rest
    render_torch(means, rotations, log_scales, opacity_logits, sh, camera).colour.mean().backward()
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
    wp.config.log_level = wp.LOG_WARNING
    check_device(arguments.device)
    if arguments.steps < 1 or not 16 <= arguments.size <= 4096:
        raise UserError("give --steps of at least 1 and a --size from 16 to 4096 pixels")
    writable_folder(arguments.out)

    scene = pawn(device=arguments.device)
    cameras = ring_of_cameras(scene.cloud, scene.plane.normal, count=8, size=arguments.size)
    views = views_of_capture(scene.cloud, cameras)
    grey = replace(scene.cloud, sh=wp.zeros_like(scene.cloud.sh))
    print(f"largest brightness gradient of a mean: {float(brightness_gradient(grey, cameras[0]).abs().max()):.2e}")
    result = finetune(grey, views, options=FinetuneOptions(iterations=arguments.steps, rates=Rates(sh_band_0=2e-2)))

    pictures = {
        "as it was": scene.cloud,
        "colours lost": grey,
        f"after {arguments.steps} steps": result.cloud,
    }
    frames = [render(cloud, cameras[0]).colour_srgb8() for cloud in pictures.values()]
    write_png(arguments.out / "finetune.png", contact_sheet(frames, 3, list(pictures)))
    for label, cloud in pictures.items():
        quality = np.mean([psnr(np.clip(render(cloud, v.camera).colour.numpy(), 0, 1), v.image) for v in views])
        print(f"{label:>18}: {quality:6.2f} dB")
    print(f"wrote finetune.png into {arguments.out}")


if __name__ == "__main__":
    with one_line_errors("finetune.py"):
        main()
