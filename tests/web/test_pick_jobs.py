"""Commands that the page of ``egs-warp pick`` starts."""

from __future__ import annotations

import subprocess
import sys
import threading
from typing import Any

import pytest

from egs_warp.web.pick_jobs import Job, progress_text

SERVING = """
import sys, time
print("preparing", file=sys.stderr, flush=True)
print("render: 100%|#####| 142/142 [00:09<00:00, 15.38frame/s]", file=sys.stderr, flush=True)
time.sleep(0.2)
print("open http://127.0.0.1:9/secret/?live", flush=True)
time.sleep(0.2)
print("egs-warp: front is taken to be 1,0,0", file=sys.stderr, flush=True)
"""


def test_progress_ends_when_a_command_serves_its_page(monkeypatch: pytest.MonkeyPatch):
    """Later lines would replace the address on the page."""
    popen = subprocess.Popen

    def started(arguments: list[str], **options: Any) -> Any:
        assert arguments[1:] == ["-m", "egs_warp.cli", "live", "x.ply"]
        return popen([sys.executable, "-c", SERVING], **options)

    monkeypatch.setattr(subprocess, "Popen", started)
    events: list[tuple[object, ...]] = []
    ended = threading.Event()

    def end(*last: object) -> None:
        events.append(last)
        ended.set()

    Job(
        ["live", "x.ply"],
        on_line=lambda line: events.append(("line", line)),
        on_address=lambda address: events.append(("address", address)),
        on_end=end,
    )
    assert ended.wait(30.0)
    assert events == [
        ("line", "preparing"),
        ("line", "render 142 of 142, 0 s left"),
        ("address", "http://127.0.0.1:9/secret/?live"),
        (0, "egs-warp: front is taken to be 1,0,0"),
    ]


@pytest.mark.parametrize(
    ("bar", "text"),
    [
        ("scene: plane, 00:00<?", "scene: plane"),
        ("prepare: body and muscles, 00:41<02:10", "prepare: body and muscles, 2 min left"),
        ("simulate: 0frame [00:00, ?frame/s]", "simulate"),
        ("render:  45%|####5     | 64/142 [00:04<00:05, 13.38frame/s]", "render 64 of 142, 5 s left"),
        ("prepare: done, 00:03", "prepare: done, 00:03"),
    ],
)
def test_a_progress_bar_becomes_a_text(bar: str, text: str):
    assert progress_text(bar) == text
