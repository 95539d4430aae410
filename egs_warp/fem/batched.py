"""Batches of worlds: records whose tensors have a leading world axis, and kernel launches over such tensors."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
import torch
import warp as wp


@dataclass(frozen=True)
class BatchedRecord:
    """Record of c worlds: each of its tensors, also in nested records, has one row per world."""

    def gather(self, worlds: torch.Tensor) -> Self:
        """Return a record of the given ``worlds`` (k,), in their order."""
        return replace(self, **{name: _rows(value, worlds) for name, value in self.batched_fields()})

    def subset(self, worlds: torch.Tensor) -> Self:
        """Return ``gather`` of ascending ``worlds``, or this record itself, without a copy, if these are all worlds."""
        _, first = next(iter(self.batched_fields()))
        return self if len(worlds) == _count(first) else self.gather(worlds)

    def scatter(self, worlds: torch.Tensor, values: Self) -> None:
        """Write the rows of ``values`` to the ``worlds`` (k,) of this record, in place."""
        for name, value in self.batched_fields():
            rows = getattr(values, name)
            if isinstance(value, BatchedRecord):
                value.scatter(worlds, rows)
            elif rows is not value:  # Records of all worlds may share a tensor, see ``subset``.
                value[worlds] = rows

    def batched_fields(self) -> list[tuple[str, Any]]:
        """Return names and values of the fields that have a world axis."""
        values = [(field.name, getattr(self, field.name)) for field in fields(self)]
        return [(name, value) for name, value in values if isinstance(value, torch.Tensor | BatchedRecord)]


def _rows(value: Any, worlds: torch.Tensor) -> Any:
    return value.gather(worlds) if isinstance(value, BatchedRecord) else value[worlds]


def _count(value: Any) -> int:
    return len(value) if isinstance(value, torch.Tensor) else _count(next(iter(value.batched_fields()))[1])


def nonzero(mask: torch.Tensor) -> torch.Tensor:
    """Return the indices (k,) int64 at which ``mask`` (c,) is true; synchronizes with the device."""
    return mask.nonzero().squeeze(1)


def repeat_offsets(offsets: np.ndarray, count: int, step: int, device: torch.device) -> torch.Tensor:
    """Repeat the index map ``offsets`` (m, ...) ``count`` times, adding ``step`` per copy: (count m, ...) int32.

    Negative entries, which mean "none", are unchanged.
    """
    first = torch.as_tensor(np.asarray(offsets, dtype=np.int32), device=device)
    shifts = step * torch.arange(count, dtype=torch.int32, device=device).reshape(-1, *[1] * first.ndim)
    return torch.where(first < 0, first, first + shifts).flatten(0, 1)


def launch_on(
    device: torch.device,
    kernel: Any,
    dim: int | tuple[int, ...],
    *,
    inputs: list[Any],
    outputs: list[Any],
    block_dim: int = 256,
) -> None:
    """Launch ``kernel`` on ``device``.

    Args:
        device: device of all tensors.
        kernel: the Warp kernel.
        dim: launch dimensions.
        inputs: arguments; a tensor is passed as a pair of the contiguous tensor and the element type of the array.
        outputs: output arguments, likewise.
        block_dim: threads per block.
    """
    target = wp.device_from_torch(device)
    input_arrays, output_arrays = ([_array(value) for value in values] for values in (inputs, outputs))
    wp.launch(kernel, dim, inputs=input_arrays, outputs=output_arrays, device=target, block_dim=block_dim)


def as_warp(tensor: torch.Tensor, dtype: Any) -> wp.array:
    """Return a Warp array that shares the memory of ``tensor``."""
    return wp.from_torch(tensor, dtype=dtype)


def _array(value: Any) -> Any:
    return as_warp(*value) if isinstance(value, tuple) else value
