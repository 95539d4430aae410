"""Progress bars whose time left is meant to be believed: of a scene, of what ``info`` finds, of a capture in another
format, of a creature's making, and of its simulation."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from itertools import accumulate
from typing import NoReturn, TextIO

from tqdm import tqdm

_DONE = {"cage": 0, "contact": 45, "front": 55, "body and muscles": 68, "stand": 85, "split": 95}
"""Percent of the time that are over when a stage begins, in the middle of four captures on a CPU (pawn, plush dog,
monkey, robot: within 15 of these)."""
_LOOKED = {"cage": 0, "front": 70, "muscles": 91}
"""The same of what ``info`` finds (pawn, plush dog, monkey, robot: within 13)."""
_CONVERTED = {".compressed.ply": 37, ".ply": 27, ".spz": 65, ".sog": 80, ".splat": 1, ".glb": 11}
"""The same of a capture that has been written and is compared (400,000 Gaussians of SH degree 3 on a CPU)."""
_SCENE = {"plane": 12, "ground": 15, "segment": 49, "inpaint": 24}
"""Percent of the time that each stage of a scene takes, in the middle of two built-in rooms, koala and narcissus on a
CPU: stages begin within 16 of where this has them."""
_UNTRAINED = 2
"""The same of a stage without its training."""
_SMOOTHING = 0.05
"""A frame in the air takes a third of one on the ground, and both come again."""


@contextmanager
def preparation_bar(*, quiet: bool = False, file: TextIO | None = None) -> Iterator[Callable[[str], None]]:
    """A bar on ``file`` (stderr); what it gives is to be called with the name of each stage as it begins."""
    with _stages("prepare", _DONE, quiet=quiet, file=file) as begins:
        yield begins


@contextmanager
def info_bar(*, quiet: bool = False, file: TextIO | None = None) -> Iterator[Callable[[str], None]]:
    """The same for ``look_into``."""
    with _stages("look", _LOOKED, quiet=quiet, file=file) as begins:
        yield begins


@contextmanager
def conversion_bar(name: str, *, quiet: bool = False, file: TextIO | None = None) -> Iterator[Callable[[str], None]]:
    """The same for a capture that is written as the ending of ``name`` says, and compared."""
    written = next(done for ending, done in _CONVERTED.items() if name.lower().endswith(ending))
    with _stages("convert", {"write": 0, "compare": written}, quiet=quiet, file=file) as begins:
        yield begins


@contextmanager
def _stages(name: str, done: Mapping[str, int], *, quiet: bool, file: TextIO | None) -> Iterator[Callable[[str], None]]:
    """``done``: percent of the time that are over when a stage begins. The bar is there from the first one on: what is
    refused before is one line."""
    form = "{desc}, {elapsed}<{remaining}"
    with ExitStack() as stack:
        bar: tqdm[NoReturn] | None = None

        def begins(stage: str) -> None:
            nonlocal bar
            if bar is None:
                made = tqdm(desc=name, total=100, bar_format=form, smoothing=0, disable=quiet, file=file)
                bar = stack.enter_context(made)
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
