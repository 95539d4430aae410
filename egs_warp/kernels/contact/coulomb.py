"""Contact forces with Coulomb friction for a given Delassus operator: sweeps, then Newton's method on projections."""

import warp as wp

from egs_warp.precision import Vec4, real

wp.set_module_options({"enable_backward": False})

_FEW_SWEEPS, _MORE_SWEEPS = wp.constant(3), wp.constant(20)
"""Before the first attempt, and before each further one."""
_Rates = wp.types.vector(7, real)
_RATES = wp.constant(_Rates(1.0, 0.3, 3.0, 0.1, 10.0, 0.03, 30.0))
"""Of the attempts. Where the kinks of the projections keep the steps of one rate from making them smaller, whole steps
of another get on. Every second attempt takes another rate in each of its steps: what goes around in a circle at one
rate leaves it."""
_BOLD = wp.constant(12)
"""Whole steps of each attempt but the first."""
_HALVINGS = wp.constant(10)
_LESS = wp.constant(real(1e-4))
"""Of a step's length: share by which it has to make the residual smaller."""
_SHORT, _SHORTER = wp.constant(real(1e-6)), wp.constant(real(1e-4))
"""Added to the diagonal of the equations of contacts that stick, whose entries are about 1: of the steps that redundant
contacts leave, a short one is taken, and rounding is not made large by those that they nearly leave. The second in the
``_CAREFUL`` first steps of all attempts but the first. Of 296 problems of jumps that 1e-9 and steps of one rate left at
1e-4 m/s, 1e-6 and another rate in each attempt leave 16; with the second, and other rates in each step of every second
attempt, 3 are left."""
_CAREFUL = wp.constant(6)
_POLISHES = wp.constant(2)
_FINEST = wp.constant(real(1e-10))
"""The same in the last steps: too small to be seen in the answer."""
_POLISHED = wp.constant(real(1e-2))
"""Of the tolerance: what is so near is left as it is."""
_SINGULAR = wp.constant(real(1e-14))
"""Of the largest pivot so far: one that is smaller leaves its unknown at zero."""


@wp.struct
class Contacts:
    """n contacts; forces and velocities are contact-major: normal and two tangents."""

    delassus: wp.array2d[real]
    """(3n, 3n) m/(N s)."""
    free: wp.array[real]
    """(3n,) m/s without forces."""
    shifts: wp.array[real]
    """(n,) m/s, added to the normal velocities."""
    friction: real


@wp.struct
class Newton:
    """Scratch memory of the search for 3n forces."""

    velocities: wp.array[real]
    values: wp.array[real]
    """(3n,) what the projection equations miss."""
    step: wp.array[real]
    change: wp.array[real]
    """(3n,) of the velocities by a whole step."""
    best: wp.array[real]
    unknowns: wp.array[int]
    """(3n,) rows that the equations do not give at once."""
    pivots: wp.array[int]
    """(3n,) in which of their columns each row has its pivot."""
    matrix: wp.array2d[Vec4]
    """(3n, >= (3n + 1) / 4) their linear equations, right sides last, columns by fours: taken at once."""


@wp.func
def sweep(contacts: Contacts, sweeps: int, forces: wp.array[real]):
    """``sweeps`` rounds over all contacts: each takes the force that its own normal and tangents ask for (Eq. 8, 9)."""
    count = contacts.shifts.shape[0]
    for _ in range(sweeps):
        for i in range(count):
            n = 3 * i
            normal_speed = contacts.free[n]
            first_speed = contacts.free[n + 1]
            second_speed = contacts.free[n + 2]
            for k in range(3 * count):
                f = forces[k]
                normal_speed += contacts.delassus[n, k] * f
                first_speed += contacts.delassus[n + 1, k] * f
                second_speed += contacts.delassus[n + 2, k] * f
            own = contacts.delassus[n, n]
            normal = wp.max(forces[n] - (normal_speed + contacts.shifts[i]) / own, real(0.0))
            change = normal - forces[n]
            stiffest = wp.max(contacts.delassus[n + 1, n + 1], contacts.delassus[n + 2, n + 2])
            first = forces[n + 1] - (first_speed + contacts.delassus[n + 1, n] * change) / stiffest
            second = forces[n + 2] - (second_speed + contacts.delassus[n + 2, n] * change) / stiffest
            length = wp.sqrt(first * first + second * second)
            share = real(1.0)
            if length > contacts.friction * normal:
                share = contacts.friction * normal / length
            forces[n] = normal
            forces[n + 1] = share * first
            forces[n + 2] = share * second


@wp.func
def rate_of(contacts: Contacts, i: int, scale: real):
    """Newtons for each m/s by which contact ``i`` is projected."""
    n = 3 * i
    trace = contacts.delassus[n, n] + contacts.delassus[n + 1, n + 1] + contacts.delassus[n + 2, n + 2]
    return scale * real(3.0) / trace


@wp.func
def missed(contacts: Contacts, forces: wp.array[real], scale: real, length: real, newton: Newton):
    """Value f - projection of f - rate u at ``length`` of the step from ``forces``; its largest part and its norm, both
    in m/s."""
    most = real(0.0)
    square = real(0.0)
    for i in range(contacts.shifts.shape[0]):
        n = 3 * i
        rate = rate_of(contacts, i, scale)
        normal = forces[n] + length * newton.step[n]
        trial = normal - rate * (newton.velocities[n] + length * newton.change[n])
        newton.values[n] = normal - wp.max(trial, real(0.0))
        radius = contacts.friction * wp.max(normal, real(0.0))
        f1 = forces[n + 1] + length * newton.step[n + 1]
        f2 = forces[n + 2] + length * newton.step[n + 2]
        first = f1 - rate * (newton.velocities[n + 1] + length * newton.change[n + 1])
        second = f2 - rate * (newton.velocities[n + 2] + length * newton.change[n + 2])
        pull = wp.sqrt(first * first + second * second)
        share = real(1.0)
        if pull > radius:
            share = radius / pull
        newton.values[n + 1] = f1 - share * first
        newton.values[n + 2] = f2 - share * second
        for t in range(3):
            speed = newton.values[n + t] / rate
            most = wp.max(most, wp.abs(speed))
            square += speed * speed
    # A maximum passes over what is no number, a sum does not.
    if not square < real(wp.inf):
        most = real(wp.inf)
    return wp.vec2d(most, wp.sqrt(square))


@wp.func
def write_equations(contacts: Contacts, forces: wp.array[real], scale: real, short: real, newton: Newton):
    """The derivative of the values, row by row as each contact separates, sticks or slides, and how many unknowns it
    leaves: steps of forces that fall to zero are their values."""
    count = contacts.shifts.shape[0]
    unknowns = int(0)
    for i in range(count):
        n = 3 * i
        rate = rate_of(contacts, i, scale)
        if forces[n] - rate * newton.velocities[n] > real(0.0):
            newton.step[n] = real(0.0)
            newton.unknowns[unknowns] = n
            unknowns += 1
        else:
            newton.step[n] = -newton.values[n]
        first = forces[n + 1] - rate * newton.velocities[n + 1]
        second = forces[n + 2] - rate * newton.velocities[n + 2]
        if forces[n] <= real(0.0) and first * first + second * second > real(0.0):
            newton.step[n + 1] = -newton.values[n + 1]
            newton.step[n + 2] = -newton.values[n + 2]
        else:
            newton.step[n + 1] = real(0.0)
            newton.step[n + 2] = real(0.0)
            newton.unknowns[unknowns] = n + 1
            newton.unknowns[unknowns + 1] = n + 2
            unknowns += 2
    for a in range(unknowns):
        row = newton.unknowns[a]
        i = row / 3
        n = 3 * i
        rate = rate_of(contacts, i, scale)
        own = real(0.0)
        normal_part = real(0.0)
        along_first = real(0.0)
        along_second = real(0.0)
        along = rate
        if row > n:
            first = forces[n + 1] - rate * newton.velocities[n + 1]
            second = forces[n + 2] - rate * newton.velocities[n + 2]
            pull = wp.sqrt(first * first + second * second)
            radius = contacts.friction * wp.max(forces[n], real(0.0))
            if pull > radius:
                # Sliding: 1 - share (1 - d d^T) (1 - rate G) - friction d by the normal force.
                share = radius / pull
                d1 = first / pull
                d2 = second / pull
                along = real(0.0)
                if row == n + 1:
                    along_first = share * (real(1.0) - d1 * d1)
                    along_second = -share * d1 * d2
                    normal_part = -contacts.friction * d1
                else:
                    along_first = -share * d1 * d2
                    along_second = share * (real(1.0) - d2 * d2)
                    normal_part = -contacts.friction * d2
                own = real(1.0)
        right = -newton.values[row]
        if own > real(0.0):
            along_first *= rate
            along_second *= rate
            for c in range(3 * count):
                newton.change[c] = (
                    along_first * contacts.delassus[n + 1, c] + along_second * contacts.delassus[n + 2, c]
                )
            newton.change[n] = newton.change[n] + normal_part
            newton.change[n + 1] = newton.change[n + 1] - along_first / rate
            newton.change[n + 2] = newton.change[n + 2] - along_second / rate
        else:
            for c in range(3 * count):
                newton.change[c] = along * contacts.delassus[row, c]
            own = short
        newton.change[row] = newton.change[row] + own
        for c in range(3 * count):
            right -= newton.change[c] * newton.step[c]
        write_row(newton.change, newton.unknowns, unknowns, right, newton.matrix, a)
    return unknowns


@wp.func
def entry(matrix: wp.array2d[Vec4], row: int, column: int):
    """Of a matrix by fours."""
    return matrix[row, column / 4][column % 4]


@wp.func
def write_row(
    values: wp.array[real], columns: wp.array[int], count: int, right: real, matrix: wp.array2d[Vec4], row: int
):
    """The ``count`` ``columns`` of ``values`` and ``right`` as ``row``."""
    for quad in range((count + 4) / 4):
        four = Vec4()
        for k in range(4):
            b = 4 * quad + k
            if b < count:
                four[k] = values[columns[b]]
            if b == count:
                four[k] = right
        matrix[row, quad] = four


@wp.func
def solve_equations(unknowns: int, newton: Newton):
    """Gaussian elimination, rows exchanged; unknowns that the others make redundant stay zero, which keeps the forces
    bounded. The step has them in the end."""
    rank = int(0)
    largest = real(0.0)
    quads = (unknowns + 4) / 4
    for j in range(unknowns):
        pivot = int(rank)
        size = real(0.0)
        for a in range(rank, unknowns):
            candidate = wp.abs(entry(newton.matrix, a, j))
            if candidate > size:
                size = candidate
                pivot = a
        if size > _SINGULAR * largest:
            largest = wp.max(largest, size)
            if pivot != rank:
                for quad in range(j / 4, quads):
                    kept = newton.matrix[rank, quad]
                    newton.matrix[rank, quad] = newton.matrix[pivot, quad]
                    newton.matrix[pivot, quad] = kept
            own = entry(newton.matrix, rank, j)
            for a in range(rank + 1, unknowns):
                factor = entry(newton.matrix, a, j) / own
                if factor != real(0.0):
                    for quad in range(j / 4, quads):
                        newton.matrix[a, quad] = newton.matrix[a, quad] - factor * newton.matrix[rank, quad]
            newton.pivots[rank] = j
            rank += 1
    for back in range(rank):
        row = rank - 1 - back
        j = newton.pivots[row]
        value = entry(newton.matrix, row, unknowns)
        for b in range(j + 1, unknowns):
            value -= entry(newton.matrix, row, b) * newton.step[newton.unknowns[b]]
        newton.step[newton.unknowns[j]] = value / entry(newton.matrix, row, j)


@wp.func
def find_step(contacts: Contacts, forces: wp.array[real], scale: real, short: real, newton: Newton):
    """A Newton step from the values at ``forces``, and what it changes of the velocities."""
    unknowns = write_equations(contacts, forces, scale, short, newton)
    solve_equations(unknowns, newton)
    for k in range(forces.shape[0]):
        speed = real(0.0)
        for c in range(forces.shape[0]):
            speed += contacts.delassus[k, c] * newton.step[c]
        newton.change[k] = speed


@wp.func
def find_velocities(contacts: Contacts, forces: wp.array[real], newton: Newton):
    """Those at ``forces``; no step is left."""
    for k in range(forces.shape[0]):
        speed = contacts.free[k]
        for c in range(forces.shape[0]):
            speed += contacts.delassus[k, c] * forces[c]
        if k % 3 == 0:
            speed += contacts.shifts[k / 3]
        newton.velocities[k] = speed
        newton.step[k] = real(0.0)
        newton.change[k] = real(0.0)


@wp.func
def move(contacts: Contacts, forces: wp.array[real], length: real, newton: Newton):
    """Go ``length`` of the step; no step is left."""
    for k in range(forces.shape[0]):
        forces[k] = forces[k] + length * newton.step[k]
        newton.velocities[k] = newton.velocities[k] + length * newton.change[k]
        newton.step[k] = real(0.0)
        newton.change[k] = real(0.0)


@wp.kernel
def coulomb_kernel(
    contacts: Contacts,
    tolerance: real,
    iterations: int,
    # In and out:
    forces: wp.array[real],
    newton: Newton,
    # Out:
    residual: wp.array[real],
):
    """In one thread: sweeps, then semismooth Newton on the projection equations of Alart and Curnier, the step halved
    until it makes them smaller; where that gets stuck, more sweeps and whole steps at other rates. ``forces`` are the
    best that were met, within the cone; ``residual`` is how far from the equations they are,
    m/s, and infinite where nothing is a number."""
    count = contacts.shifts.shape[0]
    least = real(wp.inf)
    for k in range(3 * count):
        newton.best[k] = forces[k]
    for attempt in range(7):
        scale = _RATES[attempt]
        sweeps = _MORE_SWEEPS
        steps = _BOLD
        if attempt == 0:
            sweeps = _FEW_SWEEPS
            steps = iterations
        sweep(contacts, sweeps, forces)
        find_velocities(contacts, forces, newton)
        for number in range(steps):
            short = _SHORT
            if attempt > 0 and number < _CAREFUL:
                short = _SHORTER
            if attempt % 2 == 1:
                scale = _RATES[(attempt + number) % 7]
            size = missed(contacts, forces, scale, real(0.0), newton)
            if size[0] < least:
                least = size[0]
                for k in range(3 * count):
                    newton.best[k] = forces[k]
            if size[0] < tolerance:
                break
            find_step(contacts, forces, scale, short, newton)
            length = real(1.0)
            if attempt == 0:
                found = int(0)
                for _half in range(_HALVINGS):
                    if found == 0:
                        trial = missed(contacts, forces, scale, length, newton)
                        if trial[1] < (real(1.0) - _LESS * length) * size[1]:
                            found = 1
                        else:
                            length *= real(0.5)
                if found == 0:
                    break
            move(contacts, forces, length, newton)
        if least < tolerance:
            break
    for k in range(3 * count):
        forces[k] = newton.best[k]
    if least < tolerance:
        one = real(1.0)
        find_velocities(contacts, forces, newton)
        for _ in range(_POLISHES):
            now = missed(contacts, forces, one, real(0.0), newton)
            least = now[0]
            if least < _POLISHED * tolerance:
                break
            find_step(contacts, forces, one, _FINEST, newton)
            size = missed(contacts, forces, one, one, newton)
            if not size[0] < tolerance:
                break
            least = size[0]
            move(contacts, forces, one, newton)
    residual[0] = least
    for i in range(count):
        n = 3 * i
        normal = wp.max(forces[n], real(0.0))
        pull = wp.sqrt(forces[n + 1] * forces[n + 1] + forces[n + 2] * forces[n + 2])
        share = real(1.0)
        if pull > contacts.friction * normal:
            share = contacts.friction * normal / pull
        forces[n] = normal
        forces[n + 1] = share * forces[n + 1]
        forces[n + 2] = share * forces[n + 2]


@wp.kernel
def sweeps_kernel(
    contacts: Contacts,
    sweeps: int,
    # In and out:
    forces: wp.array[real],
):
    """The sweeps alone, in one thread."""
    sweep(contacts, sweeps, forces)
