"""Many worlds side by side: records whose tensors have one row for each, and Warp's kernels over those tensors."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
import torch
import warp as wp


@dataclass(frozen=True)
class BatchedRecord:
    """A record of c worlds: each tensor in it, and in records of this kind within it, has a row for each world."""

    def gather(self, worlds: torch.Tensor) -> Self:
        """Of those ``worlds`` (k,) alone, rows of this record, in their order."""
        return replace(self, **{name: _rows(value, worlds) for name, value in self.batched_fields()})

    def subset(self, worlds: torch.Tensor) -> Self:
        """``of`` for ascending ``worlds``; where these are all, this very record, not a copy."""
        _, first = next(iter(self.batched_fields()))
        return self if len(worlds) == _count(first) else self.gather(worlds)

    def scatter(self, worlds: torch.Tensor, given: Self) -> None:
        """Write what is ``given`` of the ``worlds`` (k,) into this record's own tensors."""
        for name, value in self.batched_fields():
            if isinstance(value, BatchedRecord):
                value.scatter(worlds, getattr(given, name))
            else:
                value[worlds] = getattr(given, name)

    def batched_fields(self) -> list[tuple[str, Any]]:
        """What has a row for each world, by name."""
        values = [(field.name, getattr(self, field.name)) for field in fields(self)]
        return [(name, value) for name, value in values if isinstance(value, torch.Tensor | BatchedRecord)]


def _rows(value: Any, worlds: torch.Tensor) -> Any:
    return value.gather(worlds) if isinstance(value, BatchedRecord) else value[worlds]


def _count(value: Any) -> int:
    return len(value) if isinstance(value, torch.Tensor) else _count(next(iter(value.batched_fields()))[1])


def nonzero(mask: torch.Tensor) -> torch.Tensor:
    """(k,) int64, where ``mask`` (c,) is true. Waits for the device."""
    return mask.nonzero().squeeze(1)


def repeat_offsets(offsets: np.ndarray, count: int, step: int, device: torch.device) -> torch.Tensor:
    """``count`` copies of index map ``offsets`` (m, ...), int32, each ``step`` higher than the one before; negative
    entries, which stand for none, stay."""
    first = torch.as_tensor(np.asarray(offsets, dtype=np.int32), device=device)
    shifts = step * torch.arange(count, dtype=torch.int32, device=device).reshape(-1, *[1] * first.ndim)
    return torch.where(first < 0, first, first + shifts).flatten(0, 1)


def repeat_bounds(bounds: np.ndarray, count: int, device: torch.device) -> torch.Tensor:
    """(count m + 1,) int32: where the slots of ``count`` copies of rows begin and end, ``bounds`` (m + 1,) those of
    one."""
    last = torch.full((1,), count * int(bounds[-1]), dtype=torch.int32, device=device)
    return torch.cat([repeat_offsets(bounds[:-1], count, int(bounds[-1]), device), last])


def launch_on(
    device: torch.device,
    kernel: Any,
    dim: int | tuple[int, ...],
    *,
    inputs: list[Any],
    outputs: list[Any],
    block_dim: int = 256,
) -> None:
    """``kernel`` over tensors on ``device``: each is a pair of a contiguous tensor and the type of the kernel's array,
    or an array of Warp's, or a number."""
    target = wp.device_from_torch(device)
    given, made = ([_array(value) for value in values] for values in (inputs, outputs))
    wp.launch(kernel, dim, inputs=given, outputs=made, device=target, block_dim=block_dim)


def as_warp(tensor: torch.Tensor, dtype: Any) -> wp.array:
    """A ``tensor`` as an array of Warp's, where it lies."""
    return wp.from_torch(tensor, dtype=dtype)


def _array(value: Any) -> Any:
    return as_warp(*value) if isinstance(value, tuple) else value
