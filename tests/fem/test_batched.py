"""Batched records: gathering and scattering of some worlds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from egs_warp.fem.batched import BatchedRecord, nonzero, repeat_offsets

CPU = torch.device("cpu")


@dataclass(frozen=True)
class Inner(BatchedRecord):
    size: torch.Tensor


@dataclass(frozen=True)
class Outer(BatchedRecord):
    inner: Inner
    name: str
    places: torch.Tensor


def make_record(count: int = 4) -> Outer:
    return Outer(Inner(torch.arange(count)), "all", 10.0 * torch.arange(2 * count).reshape(count, 2))


def test_some_worlds_of_a_record() -> None:
    """In the given order, also in nested records; fields without a world axis are unchanged."""
    record = make_record()
    some = record.gather(torch.tensor([3, 1]))
    assert some.inner.size.tolist() == [3, 1] and some.name == "all"
    assert some.places.tolist() == [[60.0, 70.0], [20.0, 30.0]]
    assert record.subset(torch.arange(4)) is record
    assert record.subset(torch.tensor([0, 2])).inner.size.tolist() == [0, 2]


def test_worlds_are_written_back_in_place() -> None:
    record = make_record()
    record.scatter(torch.tensor([0, 2]), Outer(Inner(torch.tensor([7, 8])), "some", -torch.ones(2, 2)))
    assert record.inner.size.tolist() == [7, 1, 8, 3] and record.name == "all"
    assert record.places.tolist() == [[-1.0, -1.0], [20.0, 30.0], [-1.0, -1.0], [60.0, 70.0]]


def test_copies_of_an_index_map_are_concatenated() -> None:
    """Negative entries are unchanged."""
    assert repeat_offsets(np.array([[0, 2], [-1, 1]]), 3, 5, CPU).tolist() == [
        [0, 2],
        [-1, 1],
        [5, 7],
        [-1, 6],
        [10, 12],
        [-1, 11],
    ]
    assert nonzero(torch.tensor([False, True, True])).tolist() == [1, 2]
