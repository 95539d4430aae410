"""The Newton loop on a GPU takes exactly the steps that the host would take (Eq. 4, 8)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from egs_warp.contact.coulomb import FAILURE_TOLERANCE
from egs_warp.contact.newton_convergence import MAX_NEWTON_STEPS, ConvergenceState
from egs_warp.kernels.contact import newton_convergence as kernels
from egs_warp.precision import real

FIRST = ConvergenceState(tolerance=1e-8, activation_residual=1e-3, coulomb_tolerance=1e-7)
UNIT = 2.5


def in_a_loop(
    course: ConvergenceState,
    begin: float | None,
    steps: list[tuple[float, float, float]],
    device: str,
    *,
    usual: int = 1,
) -> np.ndarray:
    """Run the loop's convergence kernels on prescribed steps.

    Args:
        course: state at the start of the loop.
        begin: residual at the start; None uses that of the last trial.
        steps: residual, Coulomb violation in m/s and number of penetrating points after each step.
        device: Warp device.
        usual: 0 disables the loop.

    Returns:
        The residuals of the steps that were taken.
    """

    def array(*values: float) -> wp.array:
        return wp.array(np.array(values), dtype=real, device=device)

    told = array(*course.pack(UNIT, begin), *np.zeros(MAX_NEWTON_STEPS))
    going, size = wp.array([0], dtype=int, device=device), array(0.5 * UNIT)
    given = [wp.array([usual], dtype=int, device=device), size]
    wp.launch(kernels.init_convergence_kernel, 1, inputs=given, outputs=[told, going], device=device)
    for residual, missed, sinking in steps:
        if going.numpy()[0] == 0:
            break
        given = [array(UNIT * residual), array(missed), array(sinking)]
        wp.launch(kernels.check_convergence_kernel, 1, inputs=given, outputs=[told, going], device=device)
    found = told.numpy()
    assert found[kernels.FIRST_RESIDUAL] == UNIT * (0.5 if begin is None else begin)
    assert found[kernels.STEPS] - course.steps == found[kernels.STEPS_TAKEN]
    return found[kernels.HEADER_SIZE :][: int(found[kernels.STEPS_TAKEN])] / UNIT


def by_the_host(course: ConvergenceState, begin: float, steps: list[tuple[float, float, float]]) -> list[float]:
    """Return the residuals of the steps up to the first that ends the round or needs the host."""
    taken, before = [], begin
    for residual, missed, sinking in steps:
        taken.append(residual)
        plain = course.is_acceptable(residual) and not course.converges_slowly(residual, before)
        joins = sinking > 0 and course.may_activate_contacts(residual, before)
        if (
            not plain
            or joins
            or missed > min(course.coulomb_tolerance, FAILURE_TOLERANCE)
            or residual <= course.tolerance
        ):
            break
        course, before = course.after_steps(residual), residual
        if course.steps >= course.max_steps:
            break
    return taken


def plain(*sizes: float) -> list[tuple[float, float, float]]:
    return [(size, 0.0, 0.0) for size in sizes]


@pytest.mark.parametrize(
    ("course", "steps", "taken"),
    [
        (FIRST, plain(0.1, 0.01, 1e-4, 1e-6, 1e-9, 1e-12), 5),
        # The first step may increase the residual; a later one must reduce it sufficiently.
        (FIRST, plain(3.0, 2.9, 0.1), 2),
        (FIRST, plain(3.0, 2.0, 0.1), 3),
        (FIRST, plain(0.1, np.nan, 0.1), 2),
        (FIRST, plain(np.inf, 0.1), 1),
        (FIRST, [(0.1, 0.0, 0.0), (0.01, 0.0, 3.0), (5e-4, 0.0, 2.0), (1e-5, 0.0, 0.0)], 3),
        (FIRST, [(0.1, 0.0, 0.0), (5e-4, 0.0, 0.0), (1e-5, 0.0, 2.0), (1e-6, 0.0, 0.0)], 4),
        (replace(FIRST, activation_residual=0.0), [(0.1, 0.0, 0.0), (5e-4, 0.0, 2.0), (1e-5, 0.0, 0.0)], 3),
        (FIRST, [(0.1, 2.0 * FAILURE_TOLERANCE, 0.0), (0.01, 0.0, 0.0)], 1),
        (
            replace(FIRST, coulomb_tolerance=0.1 * FAILURE_TOLERANCE),
            [(0.1, 0.5 * FAILURE_TOLERANCE, 0.0), (0.01, 0.0, 0.0)],
            1,
        ),
        (replace(FIRST, max_steps=2), plain(0.1, 0.01, 1e-3, 1e-4), 2),
        (FIRST.after_steps(0.2, 0.1, 0.09), plain(0.06, 0.04, 1e-9), 3),
        (FIRST.after_steps(0.01, 0.3, 0.02), plain(0.3, 1e-9), 1),
        (FIRST.after_failed_step(), plain(0.4, 0.1), 1),
    ],
)
def test_a_loop_takes_the_steps_that_do_not_need_the_host(
    course: ConvergenceState, steps: list[tuple[float, float, float]], taken: int, device: str
) -> None:
    found = in_a_loop(course, None, steps, device)
    assert len(found) == taken and len(by_the_host(course, 0.5, steps)) == taken
    np.testing.assert_allclose(found, [size for size, _, _ in steps[:taken]], rtol=1e-15)


def test_the_device_loop_takes_the_steps_of_the_host(device: str) -> None:
    """Residuals decrease and increase at random; the loop starts in the middle of a round."""
    random, lengths = np.random.default_rng(0), set()
    for _ in range(100):
        course = replace(FIRST, max_steps=int(random.integers(6, 20)))
        for _ in range(random.integers(0, 5)):
            course = (
                course.after_steps(float(random.uniform(0.3, 0.6)))
                if random.random() < 0.8
                else course.after_failed_step()
            )
        falls = 0.45 * random.lognormal(-0.4, 0.5, 12)
        sizes = falls.cumprod()
        steps = [(float(size), 0.0, float(random.integers(0, 2))) for size in sizes]
        found = in_a_loop(course, 0.45, steps, device)
        np.testing.assert_allclose(found, by_the_host(course, 0.45, steps), rtol=1e-14)
        lengths.add(len(found))
    assert len(lengths) > 5


def test_a_search_does_not_continue_from_failures(device: str) -> None:
    assert len(in_a_loop(FIRST, None, plain(0.1), device, usual=0)) == 0
