"""Progress bars of a run, whose time left is meant to be believed: of a scene, of a creature's making, and of its
simulation."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import accumulate
from typing import TextIO

from tqdm import tqdm

_DONE = {"cage": 0, "contact": 45, "front": 55, "body and muscles": 68, "stand": 85, "split": 95}
"""Percent of the time that are over when a stage begins, in the middle of four captures on a CPU (pawn, plush dog,
monkey, robot: within 15 of these)."""
_SCENE = {"plane": 12, "ground": 15, "segment": 49, "inpaint": 24}
"""Percent of the time that each stage of a scene takes, in the middle of two built-in rooms, koala and narcissus on a
CPU: stages begin within 16 of where this has them."""
_UNTRAINED = 2
"""The same of a stage without its training."""
_SMOOTHING = 0.05
"""A frame in the air takes a third of one on the ground, and both come again."""


@contextmanager
def preparation_bar(*, quiet: bool = False) -> Iterator[Callable[[str], None]]:
    """A bar on stderr; what it gives is to be called with the name of each stage as it begins."""
    form = "{desc}, {elapsed}<{remaining}"
    with tqdm(desc="prepare", total=100, bar_format=form, smoothing=0, disable=quiet) as bar:

        def begins(stage: str) -> None:
            bar.set_description_str(f"prepare: {stage}", refresh=False)
            bar.update(max(_DONE.get(stage, 0) - bar.n, 0))
            bar.refresh()

        yield begins
        bar.bar_format = "{desc}, {elapsed}"
        bar.set_description_str("prepare: done", refresh=False)
        bar.update(100 - bar.n)


@contextmanager
def scene_bar(
    stages: Mapping[str, bool], *, quiet: bool = False, file: TextIO | None = None
) -> Iterator[Callable[[str, float], None]]:
    """A bar on ``file`` (stderr) for those ``stages`` of ``prepare_scene``, in its order; the value says whether all of
    a stage is done, training included. What it gives is the ``progress`` of ``prepare_scene``.
    """
    shares = {stage: _SCENE[stage] if whole else _UNTRAINED for stage, whole in stages.items()}
    begins = dict(zip(shares, accumulate(shares.values(), initial=0), strict=False))
    form = "{desc}, {elapsed}<{remaining}"
    with tqdm(desc="scene", total=sum(shares.values()), bar_format=form, smoothing=0, disable=quiet, file=file) as bar:

        def told(stage: str, done: float) -> None:
            bar.set_description_str(f"scene: {stage}", refresh=False)
            bar.update(max(begins[stage] + done * shares[stage] - bar.n, 0))
            bar.refresh()

        yield told
        bar.bar_format = "{desc}, {elapsed}"
        bar.set_description_str("scene: done", refresh=False)
        bar.update(bar.total - bar.n)


@contextmanager
def simulation_bar(*, quiet: bool = False, file: TextIO | None = None) -> Iterator[Callable[[int, int], None]]:
    """A bar on ``file`` (stderr); what it gives is the ``progress`` of ``simulate``."""
    with tqdm(desc="simulate", unit="frame", smoothing=_SMOOTHING, disable=quiet, file=file) as bar:

        def told(done: int, expected: int) -> None:
            bar.total = expected
            bar.update(done - bar.n)

        yield told
