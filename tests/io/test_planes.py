"""Plane files are read as written, and every mistake is one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.geometry.plane import Plane
from egs_warp.io.planes import read_planes, write_planes
from tests.support.scenes import FLOOR


def test_plane_files_are_checked(tmp_path: Path) -> None:
    path = tmp_path / "plane.json"
    planes = [FLOOR, Plane.from_coefficients(0.0, 1.0, 0.0, 2.0)]
    write_planes(path, planes, facts=[{"noise": 0.01}])
    for one, other in zip(read_planes(path), planes, strict=True):
        np.testing.assert_allclose([*one.normal, one.offset], [*other.normal, other.offset])
    for text, message in (
        ("{", "not readable JSON"),
        ("[]", "it has no planes"),
        ('{"planes": [{"normal": [1, 2]}]}', "plane 0 needs normal"),
        ('{"planes": [{"normal": [0, 0, 0], "offset": 1}]}', "a normal that is not zero"),
        (f'{{"planes": [{{"normal": [0, 0, {401 * "1"}], "offset": 1}}]}}', "give four finite numbers"),
    ):
        path.write_text(text)
        with pytest.raises(UserError, match=message):
            read_planes(path)
