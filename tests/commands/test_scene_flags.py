"""Notes in the terminal: problems last and marked, numbers for experts only where no report has them."""

from __future__ import annotations

import pickle

import pytest

from egs_warp.commands.scene_flags import print_notes
from egs_warp.notes import Detail, Problem

NOTES = (
    Problem("it is cut off"),
    Detail("a texel is 0.01 wide"),
    "the front is taken to be x; if that is wrong, give the front",
)


@pytest.mark.parametrize("details", [False, True])
def test_problems_are_last_and_details_are_optional(details: bool, capsys: pytest.CaptureFixture[str]) -> None:
    # A prepared scene is stored with its notes.
    print_notes(pickle.loads(pickle.dumps(NOTES)), details=details)
    assert capsys.readouterr().err.splitlines() == [
        *(["egs-warp: a texel is 0.01 wide"] if details else []),
        "egs-warp: the front is taken to be x; if that is wrong, give --front",
        "egs-warp: warning: it is cut off",
    ]
