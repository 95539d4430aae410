"""Mutation tests: ``make mutation``, or ``python -m tests.mutation --help``; see ``tests/support/mutation.py``."""

from __future__ import annotations

import sys

from tests.support.mutation import main

if __name__ == "__main__":
    sys.exit(main())
