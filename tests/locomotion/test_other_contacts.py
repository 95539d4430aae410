"""Elimination of the contacts that the planned body does not touch."""

import numpy as np
import pytest

from egs_warp.locomotion.other_contacts import OtherContacts

FRICTION, ACTIVATIONS = 0.6, 4
FORCES = np.array(
    [[1.0, 0.1, 0.0], [0.9, 0.0, 0.2], [0.0, 0.0, 0.0], [1.1, FRICTION * 1.1, 0.0], [0.7, 0.1, -0.1], [0.4, 0.0, 0.0]]
)
"""Predicted forces, with which contacts 1 and 4 stick, contact 3 slides and contact 2 is open."""
RETAINED = np.array([0, 5])


@pytest.fixture
def velocities() -> tuple[np.ndarray, np.ndarray]:
    """Rows and offset of six contacts."""
    rng = np.random.default_rng(3)
    factor = rng.normal(size=(18, 30))
    return np.hstack([rng.normal(size=(18, ACTIVATIONS)), factor @ factor.T / 30.0]), rng.normal(size=18)


def test_other_contacts_keep_their_modes(velocities: tuple[np.ndarray, np.ndarray]) -> None:
    """For any forces of the retained contacts, sticking contacts stay at rest, sliding ones stay closed at the edge of
    the cone, and open ones carry no force; the reduced rows give the velocities of the retained contacts."""
    rows, offset = velocities
    others = OtherContacts.of(RETAINED, rows, offset, FRICTION, FORCES)
    assert others is not None
    x = np.random.default_rng(4).normal(size=ACTIVATIONS + 3 * len(RETAINED))
    forces = others.all_forces(x)
    full = (rows @ np.concatenate([x[:ACTIVATIONS], forces.ravel()]) + offset).reshape(-1, 3)
    reduced_rows, reduced_offset = others.contact_rows(rows, offset)
    assert (reduced_rows @ x + reduced_offset).reshape(-1, 3) == pytest.approx(full[RETAINED], abs=1e-12)
    # The regularisation of the force equations leaves small velocities.
    assert full[[1, 4]] == pytest.approx(0.0, abs=1e-5)
    assert full[3, 0] == pytest.approx(0.0, abs=1e-5)
    assert forces[3, 1:] == pytest.approx([FRICTION * forces[3, 0], 0.0])
    assert np.all(forces[2] == 0.0)
    assert forces[RETAINED].ravel() == pytest.approx(x[ACTIVATIONS:])


def test_forces_depend_only_on_unknowns_that_move_the_eliminated_contacts(
    velocities: tuple[np.ndarray, np.ndarray],
) -> None:
    """If the activations and the first retained contact do not move the other contacts, the forces depend on the second
    retained contact only, and the reduced rows are those of the full problem."""
    rows, offset = velocities
    apart = rows.copy()
    apart[3:15, : ACTIVATIONS + 3], apart[:3, ACTIVATIONS + 3 : ACTIVATIONS + 15] = 0.0, 0.0
    others = OtherContacts.of(RETAINED, apart, offset, FRICTION, FORCES)
    assert others is not None and others.coupled.tolist() == [ACTIVATIONS + 3, ACTIVATIONS + 4, ACTIVATIONS + 5]
    x = np.random.default_rng(5).normal(size=ACTIVATIONS + 3 * len(RETAINED))
    full = apart @ np.concatenate([x[:ACTIVATIONS], others.all_forces(x).ravel()]) + offset
    reduced_rows, reduced_offset = others.contact_rows(apart, offset)
    assert reduced_rows @ x + reduced_offset == pytest.approx(full.reshape(-1, 3)[RETAINED].ravel(), abs=1e-12)


def test_nothing_is_eliminated_from_the_contacts_of_one_body(velocities: tuple[np.ndarray, np.ndarray]) -> None:
    """If the body touches all contacts, the program stays as it is."""
    rows, offset = velocities
    others = OtherContacts.of(np.arange(6), rows, offset, FRICTION, FORCES)
    assert others is not None
    reduced_rows, reduced_offset = others.contact_rows(rows, offset)
    assert np.array_equal(reduced_rows, rows)
    assert np.array_equal(reduced_offset, offset)
