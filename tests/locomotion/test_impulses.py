"""What activations of synergies push nodes with, against the columns of single muscles (Eq. 7)."""

from __future__ import annotations

import numpy as np

from egs_warp.locomotion.impulses import SynergyImpulses
from egs_warp.locomotion.synergies import Synergies
from egs_warp.muscles.tension import muscle_columns
from tests.support.creatures import coarse_pawn


def test_they_are_the_columns_of_their_muscles() -> None:
    """Each at its bound, over the time, of a body that is bent so far that some pull less; one muscle a synergy, and
    several."""
    creature = coarse_pawn()
    muscles, rest = creature.muscles, creature.body.mesh.nodes
    bent = rest * [1.0, 1.0, 0.6] + 0.01 * np.random.default_rng(0).standard_normal(rest.shape)
    other = np.arange(3.0 * len(rest))
    for most in (muscles.segment_count, 7):
        synergies = Synergies((np.arange(muscles.segment_count) % most).astype(np.int32))
        impulses = SynergyImpulses(muscles, synergies)
        for positions in (rest, bent):
            found = impulses.beside(other, positions, 0.02)
            each = muscle_columns(muscles, positions).toarray() * muscles.bounds
            expected = 0.02 * (each @ synergies.members.toarray())
            assert found.shape == (3 * len(rest), most + 1)
            np.testing.assert_allclose(found[:, :-1], expected, atol=1e-12 * np.abs(expected).max())
            np.testing.assert_array_equal(found[:, -1], other)
