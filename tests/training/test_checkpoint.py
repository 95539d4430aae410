"""Checkpoints: an interrupted training that is resumed gives results bitwise equal to those of an uninterrupted one."""

from __future__ import annotations

from pathlib import Path

import pytest

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import ARRAYS, GaussianCloud
from tests.support.training_views import ball, ring

torch = pytest.importorskip("torch")
from egs_warp.training.finetune import (  # noqa: E402
    Densification,
    FinetuneOptions,
    FinetuneResult,
    TrainingView,
    finetune,
    render_views,
)

OPTIONS = FinetuneOptions(
    iterations=230,
    background=(0.2, 0.3, 0.4),
    densification=Densification.RELOCATION,
    max_gaussians=90,
    sh_steps=60,
    fit_exposure=True,
    exclude_outliers=True,
    seed=3,
)
CUTS = (17, 104, 209)
"""Steps at which the training is interrupted: before and after Gaussians are moved and added, and after a view is
excluded."""


@pytest.fixture(autouse=True)
def one_thread(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("egs_warp.training.checkpoint.SECONDS", 0.0)
    monkeypatch.setattr("egs_warp.training.checkpoint._SHARE", 1e9)
    # With this threshold, one of the ten views is excluded early in the training.
    monkeypatch.setattr("egs_warp.training.outlier_views._TIMES_MEDIAN", 1.0)
    monkeypatch.setattr("egs_warp.training.outlier_views._SPREADS", 0.1)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def views() -> list[TrainingView]:
    """Render ten views of a ball."""
    return render_views(GaussianCloud.from_numpy(**ball(60), device="cpu"), ring(10, 24))


def start() -> GaussianCloud:
    return GaussianCloud.from_numpy(**ball(60, seed=5), device="cpu")


def bits(result: FinetuneResult) -> list[bytes]:
    assert result.tones is not None
    arrays = [getattr(result.cloud, name).numpy() for name in ARRAYS]
    return [array.tobytes() for array in (*arrays, result.losses, result.tones)]


def cut_off(views: list[TrainingView], path: Path, at: int, *, resume: bool) -> None:
    def stop(step: int, _: float) -> None:
        if step == at:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        finetune(start(), views, options=OPTIONS, checkpoint=path, resume=resume, progress=stop)


@pytest.mark.slow
@pytest.mark.parametrize("fused_on", [(), ("cpu",)])
def test_cut_off_three_times_it_has_the_same_bits(
    fused_on: tuple[str, ...], views: list[TrainingView], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The result equals that of an uninterrupted training, with PyTorch's autograd and with fused steps."""
    monkeypatch.setattr("egs_warp.training.finetune._FUSED_ON", fused_on)
    whole = finetune(start(), views, options=OPTIONS)
    assert len(whole.outliers) == 1 and whole.cloud.count == 90
    path = tmp_path / "training.npz"
    for at in CUTS:
        cut_off(views, path, at, resume=path.exists())
    seen: list[int] = []
    again = finetune(
        *(start(), views),
        options=OPTIONS,
        checkpoint=path,
        resume=True,
        progress=lambda step, _: seen.append(step),
    )
    assert seen == list(range(CUTS[-1], OPTIONS.iterations)), "steps that were done are not done again"
    assert bits(again) == bits(whole) and again.outliers == whole.outliers


def test_runs_that_cannot_be_resumed_are_reported(views: list[TrainingView], tmp_path: Path) -> None:
    path = tmp_path / "training.npz"

    def error_of(views: list[TrainingView]) -> str:
        with pytest.raises(UserError) as error:
            finetune(start(), views, options=OPTIONS, checkpoint=path, resume=True)
        return str(error.value)

    assert error_of(views) == f"{path}: there is no checkpoint of an interrupted training; start without resuming"
    cut_off(views, path, 3, resume=False)
    assert error_of(views[:9]) == (
        f"{path}: it belongs to other photos, other settings or another version of egs-warp; start the training again"
    )
    path.write_bytes(path.read_bytes()[:300])
    assert error_of(views) == f"{path}: the checkpoint is damaged; start the training again"
