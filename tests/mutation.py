"""Command line of the mutation tests (``make mutation``), which ``tests/support/mutation.py`` implements."""

from __future__ import annotations

import sys

from tests.support.mutation import main

if __name__ == "__main__":
    sys.exit(main())
