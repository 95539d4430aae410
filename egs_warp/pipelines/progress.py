"""Progress bars with calibrated remaining times, for scenes, ``info``, conversions, creatures, simulations and films.

Within the context of ``photos_bar``, other bars are not shown but report their progress to it.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from itertools import accumulate
from threading import Event, Thread
from types import TracebackType
from typing import Any, TextIO

from tqdm import tqdm

_PREPARATION_STAGES = {"cage": 0, "front": 45, "contact": 58, "body and muscles": 68, "stand": 85, "split": 95}
"""Elapsed time at the start of each stage, percent of the total. The values are medians of four captures on a CPU
(pawn, plush dog, monkey, robot), from which each capture differs by at most 15 percentage points."""
_INFO_STAGES = {"cage": 0, "front": 70, "muscles": 91}
"""Elapsed time at the start of each stage of ``info``, percent of the total, for the same four captures, which differ
from it by at most 13 percentage points."""
_BALANCE_STAGES = {"cage": 0, "front": 26, "muscles": 30, "balance": 33}
"""Elapsed time at the start of each stage of ``info`` if muscles from a file are checked in a short stand, percent of
the total (within 6 percentage points for robot and monkey)."""
_CONVERSION_STAGES = {".compressed.ply": 37, ".ply": 27, ".spz": 65, ".sog": 80, ".splat": 1, ".glb": 11}
"""Elapsed time of a conversion, by name ending, when the file has been written and its comparison with the source
starts, percent of the total (400,000 Gaussians of SH degree 3 on a CPU)."""
_PHOTOS_SHARES = {"pose": 20, "train": 50, "pick": 1, "scene": 15, "prepare": 2, "simulate": 7, "render": 5}
"""Duration of each stage from photos to a film on a CPU, percent of the total."""
_SMOOTHING = 0.05
"""Smoothing factor of the frame rate. It is small, because frames with the body in the air and on the ground alternate,
and a frame in the air takes a third of the time."""
_REFRESH_INTERVAL = 1.0
"""Interval at which a bar is redrawn, s, so that its times advance while a stage reports nothing."""
_MIN_LEFT = 0.3
"""Minimum remaining time of a stage, as a fraction of its elapsed time, because a stage that takes longer than usual is
not about to end."""
_RELIABLE_FRACTION = 0.1
"""Fraction of a stage that must be finished after its first report for its remaining time to be computed from its own
speed, not from its expected share."""
_UPDATE_INTERVAL, _LOG_INTERVAL = 0.25, 10.0
"""Intervals between two updates of ``photos_bar``, s: on a terminal, and in a log."""
_outer: ContextVar[PhotosBar | None] = ContextVar("_outer", default=None)
"""The bar to which other bars report; None if they are shown separately."""


@contextmanager
def photos_bar(stages: Sequence[str], *, quiet: bool = False, file: TextIO | None = None) -> Iterator[PhotosBar]:
    """Show one bar on ``file`` (default stderr) for all ``stages`` from photos to a film."""
    shares = {stage: _PHOTOS_SHARES[stage] for stage in stages}
    with StageBar("photos to film", shares, quiet=quiet, file=file) as bar:
        is_terminal = (file or sys.stderr).isatty()
        shown = PhotosBar(bar, _UPDATE_INTERVAL if is_terminal else _LOG_INTERVAL)
        token = _outer.set(shown)
        try:
            yield shown
        finally:
            _outer.reset(token)


class PhotosBar:
    """Bar of all stages from photos to a film."""

    def __init__(self, bar: StageBar, interval: float) -> None:
        self._bar, self._interval = bar, interval
        self._stage, self._shown = "", 0.0

    def update(self, stage: str, done: float = 0.0) -> None:
        """Report that the fraction ``done`` of ``stage`` is finished."""
        now = time.monotonic()
        if stage != self._stage or now - self._shown > self._interval:
            self._stage, self._shown = stage, now
            self._bar.update(stage, done)

    def skip(self, *stages: str) -> None:
        """Exclude stages that an earlier run has finished."""
        self._bar.skip(stages)


@contextmanager
def preparation_bar(*, quiet: bool = False, file: TextIO | None = None) -> Iterator[Callable[[str], None]]:
    """Show a bar for creating a creature on ``file`` (default stderr); call the yielded function with the name of each
    stage as it starts."""
    with _stages("prepare", _PREPARATION_STAGES, quiet=quiet, file=file) as begins:
        yield begins


@contextmanager
def info_bar(
    *, checks_balance: bool = False, quiet: bool = False, file: TextIO | None = None
) -> Iterator[Callable[[str], None]]:
    """Show a bar for ``inspect_capture``; call the yielded function with the name of each stage as it starts.

    ``checks_balance`` is True if muscles of a file are checked in a short stand.
    """
    stages = _BALANCE_STAGES if checks_balance else _INFO_STAGES
    with _stages("look", stages, quiet=quiet, file=file) as begins:
        yield begins


@contextmanager
def conversion_bar(name: str, *, quiet: bool = False, file: TextIO | None = None) -> Iterator[Callable[[str], None]]:
    """Show a bar for a conversion to the file type of ``name`` and the comparison that follows.

    Call the yielded function with the name of each stage as it starts.
    """
    written = next(done for ending, done in _CONVERSION_STAGES.items() if name.lower().endswith(ending))
    with _stages("convert", {"write": 0, "compare": written}, quiet=quiet, file=file) as begins:
        yield begins


@contextmanager
def scene_bar(costs: Mapping[str, float], *, quiet: bool = False, file: TextIO | None = None) -> Iterator[StageBar]:
    """Show a bar on ``file`` (default stderr) for ``prepare_scene``.

    ``costs`` is the result of ``SceneOptions.costs``. Pass the methods ``update`` and ``expect`` of the yielded bar to
    ``prepare_scene`` as its arguments ``progress`` and ``expect_costs``.
    """
    with StageBar("scene", costs, quiet=quiet, file=file) as bar:
        yield bar


@contextmanager
def simulation_bar(*, quiet: bool = False, file: TextIO | None = None) -> Iterator[Callable[[int, int], None]]:
    """Show a bar for a simulation on ``file`` (default stderr), and yield the argument ``progress`` of ``simulate``."""
    outer = _outer.get()
    if outer is not None:
        yield lambda done, expected: outer.update("simulate", done / max(expected, 1))
        return
    with (
        tqdm(desc="simulate", unit="frame", smoothing=_SMOOTHING, disable=quiet, file=file) as bar,
        _redrawn(bar.refresh, quiet=quiet, file=file),
    ):

        def update(done: int, expected: int) -> None:
            bar.total = expected
            bar.update(done - bar.n)

        yield update


@contextmanager
def render_bar(count: int, *, quiet: bool = False) -> Iterator[Callable[[], object]]:
    """Show a bar on stderr for the ``count`` images of a film; call the yielded function after each of them."""
    outer, done = _outer.get(), 0
    with tqdm(total=count, desc="render", unit="frame", disable=quiet or outer is not None) as bar:

        def update() -> None:
            nonlocal done
            done += 1
            bar.update()
            if outer is not None:
                outer.update("render", done / count)

        yield update


@contextmanager
def _stages(name: str, done: Mapping[str, int], *, quiet: bool, file: TextIO | None) -> Iterator[Callable[[str], None]]:
    """Show a bar with the stages that are the keys of ``done``; each value is the percentage of the expected total time
    after which its stage starts.

    The bar appears at the start of the first stage, so that an earlier error prints only one line.
    """
    ends = [*list(done.values())[1:], 100]
    shares = {stage: end - start for (stage, start), end in zip(done.items(), ends, strict=True)}
    with StageBar(name, shares, quiet=quiet, file=file) as bar:
        yield bar.update


@contextmanager
def _redrawn(draw: Callable[[], object], *, quiet: bool, file: TextIO | None) -> Iterator[None]:
    """Call ``draw`` from a thread every ``_REFRESH_INTERVAL``, if ``file`` (default stderr) is a terminal; in a log,
    every drawing would be a line."""
    if quiet or not (file or sys.stderr).isatty():
        yield
        return
    over = Event()

    def loop() -> None:
        while not over.wait(_REFRESH_INTERVAL):
            draw()

    thread = Thread(target=loop, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


class StageBar:
    """Progress line with the current stage, and the elapsed and the remaining time of a computation.

    Each stage is assumed to take a known share of the total time.
    """

    def __init__(self, name: str, shares: Mapping[str, float], *, quiet: bool, file: TextIO | None) -> None:
        self._name, self._shares = name, dict(shares)
        self.skip(())
        self._options: dict[str, Any] = {"bar_format": "{desc}", "disable": quiet, "file": file}
        self._is_quiet = quiet
        self._is_terminal = not quiet and (file or sys.stderr).isatty()
        self._outer = _outer.get()
        self._bar: Any = None
        self._stage, self._stage_start, self._done = "", 0.0, 0.0
        self._first: tuple[float, float] | None = None
        self._stack = ExitStack()

    def __enter__(self) -> StageBar:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def update(self, stage: str, done: float = 0.0) -> None:
        """Show that the fraction ``done`` of ``stage`` is finished."""
        if self._outer is not None:
            share, start = self._shares.get(stage, 0.0), self._starts.get(stage, self._total)
            self._outer.update(self._name, (start + done * share) / self._total)
            return
        if self._bar is None:
            self._bar = self._stack.enter_context(tqdm(**self._options))
            self._stack.push(self._show_end)
            self._stack.enter_context(_redrawn(self._draw, quiet=self._is_quiet, file=self._options["file"]))
        begins = stage != self._stage
        if begins:
            self._stage, self._stage_start, self._first = stage, self._elapsed(), None
        if done > 0.0 and self._first is None:
            self._first = self._elapsed(), done
        self._done = done
        if begins or self._is_terminal:
            self._draw()

    def skip(self, stages: Sequence[str]) -> None:
        """Exclude ``stages`` from the total."""
        self._shares = {stage: share for stage, share in self._shares.items() if stage not in stages}
        self._starts = dict(zip(self._shares, accumulate(self._shares.values(), initial=0.0), strict=False))
        self._total = sum(self._shares.values())

    def expect(self, shares: Mapping[str, float]) -> None:
        """Replace the expected shares of the stages with better estimates."""
        self._shares = dict(shares)
        self.skip(())

    def _show_end(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if kind is None:
            self._bar.set_description_str(f"{self._name}: done, {tqdm.format_interval(self._elapsed())}")

    def _elapsed(self) -> float:
        """Seconds since the bar appeared."""
        return 0.0 if self._is_quiet else float(self._bar.format_dict["elapsed"])

    def _draw(self) -> None:
        if self._is_quiet:
            return
        elapsed = self._elapsed()
        left = self._left(elapsed)
        remaining = "?" if left is None else tqdm.format_interval(left)
        self._bar.set_description_str(f"{self._name}: {self._stage}, {tqdm.format_interval(elapsed)}<{remaining}")

    def _left(self, elapsed: float) -> float | None:
        """Return the remaining time, s, ``elapsed`` seconds after the start; None before it can be estimated.

        The time per share is measured in the earlier stages, or in the current stage after its first report, because
        the time before that report may include an import. A stage that takes longer than its share is expected to
        continue for some time.
        """
        share, start = self._shares.get(self._stage, 0.0), self._starts.get(self._stage, self._total)
        spent = elapsed - self._stage_start
        first_time, first_done = self._first or (elapsed, self._done)
        if self._done - first_done >= _RELIABLE_FRACTION:
            stage_left = (elapsed - first_time) * (1.0 - self._done) / (self._done - first_done)
        elif start > 0.0:
            stage_left = max(self._stage_start / start * share - spent, _MIN_LEFT * spent)
        else:
            return None
        # Expected shares may be replaced by smaller ones, and a stage may be unknown.
        rest = max(self._total - start - share, 0.0)
        return stage_left + (elapsed + stage_left) * rest / (start + share)
