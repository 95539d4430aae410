"""Number of examples of the property tests, and conversion of failing examples to lines of code."""

from __future__ import annotations

import os
import re

FUZZING = os.environ.get("HYPOTHESIS_PROFILE") == "fuzz"
_FUZZ_FACTOR = 10
_FAILING = re.compile(r"^(?:Failing test case|Falsifying example): \w+\(\n(.*?)^\)", re.DOTALL | re.MULTILINE)


def examples(count: int) -> int:
    """Return the number of examples, which is ``count`` in ``make test`` and ten times as many in ``make fuzz``."""
    return _FUZZ_FACTOR * count if FUZZING else count


def example_lines(traceback: str) -> list[str]:
    """Return an ``@example(...)`` line for each failing example that Hypothesis printed in ``traceback``.

    Examples drawn with ``st.data()`` have no such line; Hypothesis prints ``@reproduce_failure(...)`` for them.
    """
    text = re.sub(r"^E   ", "", traceback, flags=re.MULTILINE)
    found = []
    for arguments in _FAILING.findall(text):
        if "data(...)" in arguments:
            continue
        joined = " ".join(re.sub(r"\s+# .*$", "", line).strip() for line in arguments.splitlines())
        found.append("@example(" + re.sub(r",\s*(\)|$)", r"\1", joined.replace("( ", "(").strip()) + ")")
    return found
