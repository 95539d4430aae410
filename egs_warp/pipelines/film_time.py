"""Note to the user if the film will take longer than its simulation, given early enough to choose a preview instead."""

from __future__ import annotations

import time
from collections.abc import Callable

from tqdm import tqdm

_FIRST_FRAMES = 10
"""Number of simulated frames after which the speed of the simulation is considered known."""
_SETUP_FRAMES = 2
"""Number of initial frames that are not timed, because the first steps may compile kernels."""


class FilmTimeNote:
    """Comparison of the measured time of a simulation with the expected time of its film.

    ``update`` is a ``progress`` callback of ``simulate``.
    """

    def __init__(self, picture_seconds: float, pictures_per_frame: float, show_note: Callable[[str], object]) -> None:
        """Create the comparison.

        Args:
            picture_seconds: Time for drawing one picture, s.
            pictures_per_frame: Number of pictures of the film for each simulated frame.
            show_note: Called with the note, at most once.
        """
        self._seconds = picture_seconds * pictures_per_frame
        self._show_note = show_note
        self._started = 0.0

    def update(self, done: int, expected: int) -> None:
        """Show the note as soon as the speed of the simulation is known, if the film will take longer.

        Args:
            done: Number of finished frames.
            expected: Number of frames expected in total.
        """
        if done == _SETUP_FRAMES:
            self._started = time.perf_counter()
        if done != _FIRST_FRAMES:
            return
        simulation = (time.perf_counter() - self._started) / (_FIRST_FRAMES - _SETUP_FRAMES)
        if self._seconds > simulation:
            film, run = (tqdm.format_interval(each * expected) for each in (self._seconds, simulation))
            self._show_note(
                f"the film takes about {film}, after {run} of simulation; a preview draws it smaller and with fewer"
                " Gaussians"
            )
