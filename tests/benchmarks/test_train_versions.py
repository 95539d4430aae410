"""Aim of the preview: in each scene, the PSNR of an older version in a third of its time."""

from __future__ import annotations

from types import ModuleType

import pytest

from tests.support.scripts import BENCHMARKS, module_of

Pair = tuple[float, float]
"""Values of the first and of the second seed."""


@pytest.fixture
def versions(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return module_of("train_versions")


@pytest.mark.parametrize(
    ("seconds", "psnr", "is_met"),
    [((30.0, 36.0), (24.0, 26.0), True), ((30.0, 38.0), (24.0, 26.0), False), ((30.0, 30.0), (24.0, 25.8), False)],
)
def test_the_means_over_the_seeds_count(versions: ModuleType, seconds: Pair, psnr: Pair, is_met: bool) -> None:
    def rows(case: str, method: str, times: Pair, quality: Pair) -> list[dict[str, object]]:
        common = {"case": case, "method": method}
        return [{**common, "seconds": times[k], "held_out_psnr": quality[k]} for k in (0, 1)]

    old = [row for case in ("bonsai", "mouse") for row in rows(case, versions.OLD, (90.0, 108.0), (25.0, 25.0))]
    new = [*rows("bonsai", versions.NEW, (9.0, 9.0), (29.0, 29.0)), *rows("mouse", versions.NEW, seconds, psnr)]
    assert versions.is_third_of_time([*old, *new]) is is_met
