"""Threads of linear algebra: the dense matrices of a step are small."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache

from threadpoolctl import ThreadpoolController


@cache
def _libraries() -> ThreadpoolController:
    # NumPy's and SciPy's own, both loaded by now; looking for them takes some milliseconds.
    return ThreadpoolController()


def one_blas_thread() -> AbstractContextManager[object]:
    """While it lasts, BLAS runs on one thread: more cost a step half as much again, and tenfold beside other work."""
    return _libraries().limit(limits=1, user_api="blas")
