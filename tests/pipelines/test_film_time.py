"""Note about a film that takes longer than its simulation."""

from __future__ import annotations

import pytest

from egs_warp.pipelines.film_time import FilmTimeNote


@pytest.mark.parametrize("picture_seconds, count", [(0.11, 1), (0.09, 0)])
def test_a_film_slower_than_its_simulation_is_announced_once(
    picture_seconds: float, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Simulating a frame takes 0.2 s, except for the first, which takes 5 s and is not counted. Rendering it takes two
    pictures, that is 0.22 or 0.18 s, and the note appears only in the first case."""
    clock = [0.0]
    monkeypatch.setattr("egs_warp.pipelines.film_time.time.perf_counter", lambda: clock[0])
    notes: list[str] = []
    note = FilmTimeNote(picture_seconds, 2.0, notes.append)
    for done in range(1, 60):
        clock[0] += 5.0 if done == 1 else 0.2
        note.update(done, 300)
    assert len(notes) == count
    if count:
        assert notes[0].startswith("the film takes about 01:06, after 01:00 of simulation; a preview draws it smaller")
