"""Distinct rows of integer arrays."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.geometry.unique_rows import distinct_rows


@pytest.mark.parametrize("count", [0, 1, 500])
@pytest.mark.parametrize("width", [2, 3])
@pytest.mark.parametrize(
    ("unit", "whole"), [(1, np.int32), (2**28, np.int32), (1, np.int64), (2**28, np.int64), (10**18, np.int64)]
)
def test_distinct_rows_equal_those_of_numpy(count: int, width: int, unit: int, whole: type) -> None:
    """Order and indices equal NumPy's, also for negative numbers and for values too large to be packed into one number
    per row."""
    rows = np.random.default_rng(count).integers(-4, 4, (count, width)) * [unit, *[1] * (width - 1)]
    rows = rows.astype(whole)
    distinct, number = distinct_rows(rows)
    wanted, which = np.unique(rows, axis=0, return_inverse=True)
    assert np.array_equal(distinct, wanted) and np.array_equal(number, which.ravel())
    assert np.array_equal(distinct[number], rows)
