"""Hook of mkdocs: remove links to pages that ``make pictures`` has not made, so that the site has no dead links."""

from __future__ import annotations

import re
from typing import Any

_LINK = re.compile(r"^\[[^]]*\]\((assets/pages/[\w-]+\.html)\).*\n", re.MULTILINE)


def on_page_markdown(markdown: str, files: Any, **_: Any) -> str:
    """Remove the links to missing pages from the text of a page, for mkdocs; ``files`` are the files of the site."""
    return _LINK.sub(lambda link: link[0] if files.get_file_from_path(link[1]) else "", markdown)
