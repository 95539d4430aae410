"""Image measure of Figure 7, and its target image."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tests.support.scripts import BENCHMARKS, module_of


@pytest.fixture
def figure7(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return module_of("figure7")


def test_scores_of_a_known_image(figure7: ModuleType) -> None:
    """Compute the scores of a known image.

    The upper half has the value 0.5 and the target 0.6, so its PSNR is 20 dB. The lower half has the value 0.1 and the
    target 0: the residual is a fifth of the upper half, and the mean square error of the whole image is 0.01, too.
    """
    picture = np.concatenate([np.full((16, 32, 3), 0.5), np.full((16, 32, 3), 0.1)]).astype(np.float32)
    wanted = np.full((16, 32, 3), 0.6, np.float32)
    scores = figure7.table3.scores([picture], [wanted])
    assert scores["psnr"] == pytest.approx(20.0, abs=1e-4)
    assert scores["residual"] == pytest.approx(0.2, abs=1e-6)
    assert scores["whole_psnr"] == pytest.approx(20.0, abs=1e-4)
    own = figure7.table3.scores([picture], None)
    assert own["psnr"] is None
    # Only the lower half has an error: 0.01 over half of the pixels.
    assert own["whole_psnr"] == pytest.approx(-10 * np.log10(0.005), abs=1e-4)


def rows(ours: tuple[float, float], split: tuple[float, float]) -> list[dict[str, Any]]:
    figures = {"hard assignment": (None, 0.05), "remove": (31.0, 0.0), "static split": split, "L_seg": ours}
    return [{"scene": "koala.ply", "method": way, "psnr": dB, "residual": left} for way, (dB, left) in figures.items()]


def test_the_target_is_clearance_first_and_appearance_second(figure7: ModuleType) -> None:
    assert figure7.judge(rows((39.0, 0.001), (42.0, 0.012)), [])[0] == {"figure7_best": True}
    assert figure7.judge(rows((39.0, 0.001), (42.0, 0.0019)), [])[0] == {"figure7_best": False}
    assert figure7.judge(rows((39.0, 0.003), (42.0, 0.012)), [])[0] == {"figure7_best": False}
    assert figure7.judge(rows((30.0, 0.001), (42.0, 0.012)), [])[0] == {"figure7_best": False}


def test_without_a_scene_nothing_is_judged(figure7: ModuleType) -> None:
    aims, why = figure7.judge(rows((39.0, 0.001), (42.0, 0.012)), ["fox.ply"])
    assert aims == {"figure7_best": None}
    assert why == {"figure7_best": "without fox.ply; set EGS_WARP_DATA"}
