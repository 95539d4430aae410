"""Photo loss of the kernels and its gradients, which equal a reference in PyTorch."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from torch import Tensor

torch = pytest.importorskip("torch")
from egs_warp.training.metrics import ssim  # noqa: E402
from egs_warp.training.photo_loss import PhotoLoss, Target  # noqa: E402


def twin(
    colour: Tensor, alpha: Tensor, tone: Tensor, target: Target, backdrop: tuple[float, float, float], weight: float
) -> Tensor:
    """Return the loss computed with PyTorch, which can also differentiate it."""
    behind = torch.tensor(backdrop)
    image = target.image
    if target.alpha is None:
        toned = colour @ tone[:, :3].T + tone[:, 3]
    else:
        toned = colour @ tone[:, :3].T + alpha[:, :, None] * tone[:, 3] + (1 - alpha)[:, :, None] * behind
        image = image * target.alpha[:, :, None] + (1 - target.alpha)[:, :, None] * behind
    off = (toned - image).abs()
    if target.weight is not None:
        off = off * target.weight[:, :, None]
        toned = torch.where(target.weight[:, :, None] > 0, toned, image)
    return (1 - weight) * off.mean() + weight * (1 - ssim(toned, image))


@pytest.mark.parametrize("cut_out", [False, True])
@pytest.mark.parametrize("weighted", [False, True])
def test_loss_and_gradients_equal_the_twins(cut_out: bool, weighted: bool, device: str) -> None:
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator)

    weight = random(19, 23) if weighted else None
    if weight is not None:
        weight[5:9, 4:12] = 0.0
    target = Target(random(19, 23, 3), random(19, 23) if cut_out else None, weight)
    given = [random(19, 23, 3), random(19, 23), torch.eye(3, 4) + 0.1 * random(3, 4)]
    plain = [value.clone().requires_grad_() for value in given]
    fast = [value.clone().to("cuda" if device != "cpu" else "cpu").requires_grad_() for value in given]
    backdrop = (0.2, 0.9, 0.4)
    wanted = twin(plain[0], plain[1], plain[2], target, backdrop, 0.2)
    moved = {name: None if v is None else v.to(fast[0].device) for name, v in vars(target).items()}
    there = replace(target, **moved)
    got = PhotoLoss(0.2, str(fast[0].device), None)(fast[0], fast[1], fast[2], there, backdrop)
    assert got.item() == pytest.approx(wanted.item(), rel=1e-5)
    (3 * wanted).backward()
    (3 * got).backward()
    for a, b in zip(fast, plain, strict=True):
        if b.grad is None or not b.grad.any():
            assert a.grad is None
            continue
        assert a.grad is not None
        torch.testing.assert_close(a.grad.cpu(), b.grad, rtol=2e-4, atol=1e-7)


def test_the_loss_does_not_depend_on_the_number_of_sizes_with_buffers(device: str) -> None:
    """Buffers of at most one size are released whenever the size changes."""
    where = "cuda" if device != "cpu" else "cpu"
    generator = torch.Generator().manual_seed(0)
    tone = torch.eye(3, 4, device=where)
    images = [torch.rand((size, 23, 3), generator=generator).to(where) for size in (19, 31)]
    few, all_sizes = PhotoLoss(0.2, where, None, max_sizes=1), PhotoLoss(0.2, where, None)
    for image in [*images, *images]:
        alpha, target = image[:, :, 0].contiguous(), Target(image.flip(0).contiguous(), None, None)
        losses = [loss(image, alpha, tone, target, (0.0, 0.0, 0.0)).item() for loss in (few, all_sizes)]
        assert losses[0] == losses[1] and len(few._scratch) == 1
