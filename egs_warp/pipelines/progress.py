"""Progress bars with calibrated remaining times: for scenes, ``info``, conversions, creatures and simulations."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from itertools import accumulate
from typing import NoReturn, TextIO

from tqdm import tqdm

_PREPARATION_STAGES = {"cage": 0, "contact": 45, "front": 55, "body and muscles": 68, "stand": 85, "split": 95}
"""Percent of the time that have passed when a stage starts: median of four captures on a CPU (pawn, plush dog, monkey,
robot: within 15 of these)."""
_INFO_STAGES = {"cage": 0, "front": 70, "muscles": 91}
"""Percent of the time that have passed when a stage of ``info`` starts (pawn, plush dog, monkey, robot: within 13)."""
_CONVERSION_STAGES = {".compressed.ply": 37, ".ply": 27, ".spz": 65, ".sog": 80, ".splat": 1, ".glb": 11}
"""Percent of the time that have passed when the comparison after writing a capture starts (400,000 Gaussians of SH
degree 3 on a CPU)."""
_SCENE_SHARES = {"plane": 12, "ground": 15, "segment": 49, "inpaint": 24}
"""Percent of the time that each stage of a scene takes: median of two built-in scenes, koala and narcissus on a CPU;
stages start within 16 of these."""
_UNTRAINED_SHARE = 2
"""Percent of the time that a stage takes without its training."""
_SMOOTHING = 0.05
"""Smoothing factor of the frame rate; small, because a frame in the air takes a third of the time of one on the ground,
and both alternate."""


@contextmanager
def preparation_bar(*, quiet: bool = False, file: TextIO | None = None) -> Iterator[Callable[[str], None]]:
    """Show a bar on ``file`` (default stderr); call the yielded function with the name of each stage as it starts."""
    with _stages("prepare", _PREPARATION_STAGES, quiet=quiet, file=file) as begins:
        yield begins


@contextmanager
def info_bar(*, quiet: bool = False, file: TextIO | None = None) -> Iterator[Callable[[str], None]]:
    """Show a bar for ``inspect_capture``; call the yielded function with the name of each stage as it starts."""
    with _stages("look", _INFO_STAGES, quiet=quiet, file=file) as begins:
        yield begins


@contextmanager
def conversion_bar(name: str, *, quiet: bool = False, file: TextIO | None = None) -> Iterator[Callable[[str], None]]:
    """Show a bar for a conversion to the file type of ``name`` and the comparison that follows."""
    written = next(done for ending, done in _CONVERSION_STAGES.items() if name.lower().endswith(ending))
    with _stages("convert", {"write": 0, "compare": written}, quiet=quiet, file=file) as begins:
        yield begins


@contextmanager
def _stages(name: str, done: Mapping[str, int], *, quiet: bool, file: TextIO | None) -> Iterator[Callable[[str], None]]:
    """Show a bar whose stages start at ``done`` percent of the time.

    The bar appears with the first stage, so that an error before it prints only one line.
    """
    form = "{desc}, {elapsed}<{remaining}"
    with ExitStack() as stack:
        bar: tqdm[NoReturn] | None = None

        def begins(stage: str) -> None:
            nonlocal bar
            if bar is None:
                new_bar = tqdm(desc=name, total=100, bar_format=form, smoothing=0, disable=quiet, file=file)
                bar = stack.enter_context(new_bar)
            bar.set_description_str(f"{name}: {stage}", refresh=False)
            bar.update(max(done.get(stage, 0) - bar.n, 0))
            bar.refresh()

        yield begins
        if bar is not None:
            bar.bar_format = "{desc}, {elapsed}"
            bar.set_description_str(f"{name}: done", refresh=False)
            bar.update(100 - bar.n)


@contextmanager
def scene_bar(
    stages: Mapping[str, bool], *, quiet: bool = False, file: TextIO | None = None
) -> Iterator[Callable[[str, float], None]]:
    """Show a bar on ``file`` (default stderr) for ``prepare_scene``, and yield its ``progress`` argument.

    ``stages`` are those of ``SceneOptions.stages``: the value is False for a stage without its training.
    """
    shares = {stage: _SCENE_SHARES[stage] if whole else _UNTRAINED_SHARE for stage, whole in stages.items()}
    begins = dict(zip(shares, accumulate(shares.values(), initial=0), strict=False))
    form = "{desc}, {elapsed}<{remaining}"
    with tqdm(desc="scene", total=sum(shares.values()), bar_format=form, smoothing=0, disable=quiet, file=file) as bar:

        def update(stage: str, done: float) -> None:
            bar.set_description_str(f"scene: {stage}", refresh=False)
            bar.update(max(begins[stage] + done * shares[stage] - bar.n, 0))
            bar.refresh()

        yield update
        bar.bar_format = "{desc}, {elapsed}"
        bar.set_description_str("scene: done", refresh=False)
        bar.update(bar.total - bar.n)


@contextmanager
def simulation_bar(*, quiet: bool = False, file: TextIO | None = None) -> Iterator[Callable[[int, int], None]]:
    """Show a bar on ``file`` (default stderr), and yield the ``progress`` argument of ``simulate``."""
    with tqdm(desc="simulate", unit="frame", smoothing=_SMOOTHING, disable=quiet, file=file) as bar:

        def update(done: int, expected: int) -> None:
            bar.total = expected
            bar.update(done - bar.n)

        yield update
