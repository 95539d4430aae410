"""Checks of a page by the npm package axe-core, which tests the WCAG rules that can be tested automatically."""

from __future__ import annotations

from functools import cache
from typing import Any

import pytest

from egs_warp.web.page import PAGE

_AXE = PAGE.parent / "client" / "node_modules" / "axe-core" / "axe.min.js"
needs_axe = pytest.mark.skipif(not _AXE.is_file(), reason="axe-core is not installed in egs_warp/web/client")
_RUN = """async (context) => {
    const { violations } = await axe.run(context ?? document);
    return violations.flatMap(({ id, help, nodes }) =>
        nodes.map(({ html, target }) => `${id} (${help}): ${target.flat().join(" ")}: ${html.slice(0, 160)}`));
}"""


@cache
def axe() -> str:
    """Return the script that a page has to run before ``violations`` is called."""
    return _AXE.read_text(encoding="utf-8")


def violations(page: Any, context: str | None = None) -> list[str]:
    """Return a line for each element that violates a rule, in the whole page or in the part selected by ``context``."""
    return page.evaluate(_RUN, context)
