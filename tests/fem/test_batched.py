"""Batched records: gathering and scattering of a subset of the worlds."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from egs_warp.fem.batched import BatchedRecord, nonzero, padded


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
    """A subset has the worlds in the given order, also in nested records; fields without a world axis are unchanged."""
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


def test_indices_of_a_mask_and_padding() -> None:
    assert nonzero(torch.tensor([False, True, True])).tolist() == [1, 2]
    assert padded(torch.tensor([[1, 2]]), 1).tolist() == [[1, 2, 0]]
