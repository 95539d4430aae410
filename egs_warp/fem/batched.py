"""Arrays of one world or of many: records with a leading world axis, and kernel launches on NumPy arrays or PyTorch
tensors.

PyTorch is not imported here, so that it is not required for one world on a CPU.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from types import ModuleType
from typing import TYPE_CHECKING, Any, Self, TypeAlias, TypeVar

import numpy as np
import warp as wp

from egs_warp.launching import launch_cached

if TYPE_CHECKING:
    import torch

Array: TypeAlias = "np.ndarray | torch.Tensor"
"""A NumPy array or a PyTorch tensor."""
ArrayT = TypeVar("ArrayT", "np.ndarray", "torch.Tensor")
"""Type of the arrays of a record or a function: all NumPy arrays, or all PyTorch tensors."""


@dataclass(frozen=True)
class BatchedRecord:
    """Record of c worlds: each of its arrays, also in nested records, has one row per world."""

    def gather(self, worlds: Array) -> Self:
        """Return a record of the given ``worlds`` (k,), in their order."""
        return self._map(lambda values: values[worlds])

    def with_world_axis(self) -> Self:
        """Return this record, which has no world axis, as a record with a world axis of length 1."""
        return self._map(lambda values: values[None])

    @classmethod
    def concatenated(cls, records: Sequence[Self]) -> Self:
        """Return the record of the worlds of all ``records``. Fields that are not arrays are taken from the first
        record."""
        columns = {}
        for name, first in records[0].batched_fields():
            values = [getattr(record, name) for record in records]
            is_record = isinstance(first, BatchedRecord)
            columns[name] = (type(first).concatenated if is_record else array_module(first).concatenate)(values)
        return replace(records[0], **columns)

    def subset(self, worlds: Array) -> Self:
        """Return a record of the ascending ``worlds`` (k,); if these are all worlds, this record itself, uncopied."""
        return self if len(worlds) == len(self._leaves()[0]) else self.gather(worlds)

    def scatter(self, worlds: Array, values: Self) -> None:
        """Write the rows of ``values`` to the ``worlds`` (k,) of this record, in place."""
        for name, value in self.batched_fields():
            rows = getattr(values, name)
            if isinstance(value, BatchedRecord):
                value.scatter(worlds, rows)
            elif rows is not value:  # The records of all worlds may share a tensor, see ``subset``.
                value[worlds] = rows

    def download(self) -> list[Self]:
        """Return the record of each world on the host, with NumPy arrays and Python numbers."""
        columns = {
            name: value.download() if isinstance(value, BatchedRecord) else _rows_on_host(value)
            for name, value in self.batched_fields()
        }
        rows = zip(*columns.values(), strict=True)
        return [replace(self, **dict(zip(columns, row, strict=True))) for row in rows]

    def on_host(self) -> Self:
        """Return this record of c worlds with NumPy arrays of float64, with one transfer from the device."""
        leaves = self._leaves()
        flat = sys.modules["torch"].cat([each.reshape(len(each), -1).double() for each in leaves], dim=1).cpu().numpy()
        widths = np.cumsum([each[0].numel() for each in leaves])
        columns = np.split(flat, widths[:-1], axis=1)
        parts = iter(columns)
        return self._map(lambda values: next(parts).reshape(values.shape))

    def _leaves(self) -> list[Any]:
        """Return the arrays of this record and of its nested records, in the order of the fields."""
        leaves = []
        for _, value in self.batched_fields():
            leaves += value._leaves() if isinstance(value, BatchedRecord) else [value]
        return leaves

    def _map(self, function: Callable[[Any], Any]) -> Self:
        """Return this record with ``function`` of each of its arrays, in the order of ``_leaves``."""
        values = {
            name: value._map(function) if isinstance(value, BatchedRecord) else function(value)
            for name, value in self.batched_fields()
        }
        return replace(self, **values)

    def batched_fields(self) -> list[tuple[str, Any]]:
        """Return the names and values of the fields that are arrays or records of arrays."""
        values = [(field.name, getattr(self, field.name)) for field in fields(self)]
        return [(name, value) for name, value in values if isinstance(value, BatchedRecord) or hasattr(value, "ndim")]


def _rows_on_host(value: torch.Tensor) -> list[Any]:
    return value.tolist() if value.ndim == 1 else list(value.cpu().numpy())


def nonzero(mask: torch.Tensor) -> torch.Tensor:
    """Return the indices (k,) int64 at which ``mask`` (c,) is true; synchronises with the device."""
    return mask.nonzero().squeeze(1)


def array_module(values: Array) -> ModuleType:
    """Return the module, NumPy or PyTorch, whose functions accept ``values``."""
    return np if isinstance(values, np.ndarray) else sys.modules["torch"]


def empty_like(values: ArrayT, shape: tuple[int, ...]) -> ArrayT:
    """Return an uninitialised array of ``shape``, of the kind, type and device of ``values``."""
    return np.empty(shape, values.dtype) if isinstance(values, np.ndarray) else values.new_empty(shape)


def padded(values: torch.Tensor, more: int) -> torch.Tensor:
    """Pad the tensor ``values`` (c, K, ...) with ``more`` zeros along the second axis."""
    if not more:
        return values
    wide = values.new_zeros((len(values), values.shape[1] + more, *values.shape[2:]))
    wide[:, : values.shape[1]] = values
    return wide


def contiguous(values: ArrayT) -> ArrayT:
    """Return ``values``, or a contiguous copy; a NumPy array is also converted to int32 or float64."""
    if isinstance(values, np.ndarray):
        return np.ascontiguousarray(values, np.int32 if values.dtype.kind == "i" else np.float64)
    return values.contiguous()


def launch_on(
    target: Array,
    kernel: Any,
    dim: int | tuple[int, ...],
    *,
    inputs: list[Any],
    outputs: list[Any],
    block_dim: int = 256,
) -> None:
    """Launch ``kernel`` on the device of ``target``.

    Args:
        target: any array or tensor on the device.
        kernel: the Warp kernel.
        dim: launch dimensions.
        inputs: arguments; a contiguous array or tensor is given as a pair (array, element type).
        outputs: output arguments, given in the same form.
        block_dim: threads per block.
    """
    input_arrays, output_arrays = ([_array(value) for value in values] for values in (inputs, outputs))
    if isinstance(target, np.ndarray):
        launch_cached(kernel, dim, inputs=input_arrays, outputs=output_arrays, device=wp.get_device("cpu"))
        return
    device = wp.device_from_torch(target.device)
    wp.launch(kernel, dim, inputs=input_arrays, outputs=output_arrays, device=device, block_dim=block_dim)


def as_warp(values: Array, dtype: type) -> wp.array:
    """Return a Warp array that shares the memory of ``values``, a tensor or a NumPy array."""
    if isinstance(values, np.ndarray):
        return wp.array(values, dtype=dtype, device="cpu", copy=False)
    return wp.from_torch(values, dtype=dtype)


def as_world(array: wp.array) -> wp.array:
    """Return ``array`` (n,) with a leading axis of one world, (1, n)."""
    return array.reshape((1, array.shape[0]))


def _array(value: Any) -> Any:
    return as_warp(*value) if isinstance(value, tuple) else value


def allocate_struct(struct: Any, shapes: Mapping[str, tuple[int, ...]], device: wp.Device, **arrays: wp.array) -> Any:
    """Return an instance of a Warp ``struct`` with zeroed arrays on ``device`` in the fields of ``shapes``, and with
    the given ``arrays`` in the other fields."""
    instance = struct()
    for name, array in (_zeroed_fields(struct, shapes, device) | arrays).items():
        setattr(instance, name, array)
    return instance


def _zeroed_fields(struct: Any, shapes: Mapping[str, tuple[int, ...]], device: wp.Device) -> dict[str, wp.array]:
    """Return zeroed arrays of the given ``shapes`` with the element types of the fields of ``struct``."""
    return {name: wp.zeros(shape, dtype=struct.vars[name].type.dtype, device=device) for name, shape in shapes.items()}


class StructPerWorld:
    """Device array of Warp structs, one for each of B worlds, together with the arrays to which the structs refer.

    ``structs`` (B,) is the argument of a kernel. The structs contain only the addresses of the arrays, so this object
    must exist as long as the structs are used.
    """

    def __init__(
        self, struct: Any, shapes: Mapping[str, tuple[int, ...]], worlds: int, device: wp.Device, **arrays: wp.array
    ) -> None:
        """Allocate zeroed arrays.

        Args:
            struct: Warp struct type, with the arrays as fields.
            shapes: shape of each array in one world, by field.
            worlds: number of worlds B.
            device: device of the arrays.
            arrays: arrays that all worlds share, by field.
        """
        own = _zeroed_fields(struct, {name: (worlds, *shape) for name, shape in shapes.items()}, device)
        self._arrays = own | arrays  # The structs hold only addresses.
        table: Any = np.zeros(worlds, struct.numpy_dtype())
        for name, array in own.items():
            table[name] = array[0].__ctype__().numpy_value()
            stride = array.size * wp.types.type_size_in_bytes(array.dtype) // worlds
            table[name]["data"] += np.uint64(stride) * np.arange(worlds, dtype=np.uint64)
        for name, array in arrays.items():
            table[name] = array.__ctype__().numpy_value()
        self.structs = wp.array(table, dtype=struct, device=device)
