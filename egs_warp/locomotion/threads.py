"""Limit on the number of BLAS threads, because the dense matrices of a step are too small for several threads."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache

from threadpoolctl import ThreadpoolController


@cache
def _libraries() -> ThreadpoolController:
    # BLAS libraries of NumPy and SciPy, both of which are loaded at the first call. The result is cached, because
    # finding the libraries takes milliseconds.
    return ThreadpoolController()


def one_blas_thread() -> AbstractContextManager[object]:
    """Return a context manager that limits BLAS to one thread. With more threads, a step takes 50 % longer; if other
    processes use the cores, it takes ten times as long."""
    return _libraries().limit(limits=1, user_api="blas")
