"""Evaluation of a level set, a triquadratic B-spline on a cubic lattice: value and gradient."""

import warp as wp

from egs_warp.kernels.contact.height_field import spline_slopes, spline_weights
from egs_warp.precision import Vec3, Vec4, real

wp.set_module_options({"enable_backward": False})


@wp.struct
class LevelSetLattice:
    """Lattice of the coefficients of a level set."""

    counts: wp.vec3i
    """Number of nodes along each axis; the last axis of the coefficients varies fastest."""
    origin: Vec3
    """Position of node (0, 0, 0), m."""
    spacing: real
    """Distance between nodes, m."""


@wp.func
def level_set_value_and_gradient(lattice: LevelSetLattice, coefficients: wp.array[float], x: Vec3) -> Vec4:
    """Return the gradient of the level set at ``x`` and, as the last component, its value in metres.

    The domain of the spline is the lattice without its outermost half cells. Outside the domain, the value is that at
    the nearest point of the domain plus the distance to this point.
    """
    u = (x - lattice.origin) / lattice.spacing
    f = Vec3()
    nearest = wp.vec3i()
    outside = Vec3()
    for axis in range(3):
        # The outermost half cells lack a neighbour on one side.
        inner = wp.clamp(u[axis], real(0.5), real(lattice.counts[axis]) - real(1.5))
        nearest[axis] = wp.clamp(int(wp.floor(inner + real(0.5))), 1, lattice.counts[axis] - 2)
        f[axis] = inner - real(nearest[axis])
        outside[axis] = u[axis] - inner
    across = spline_weights(f[0])
    along = spline_weights(f[1])
    up = spline_weights(f[2])
    across_slope = spline_slopes(f[0])
    along_slope = spline_slopes(f[1])
    up_slope = spline_slopes(f[2])
    value = real(0.0)
    gradient = Vec3()
    for i in range(3):
        for j in range(3):
            row = ((nearest[0] + i - 1) * lattice.counts[1] + nearest[1] + j - 1) * lattice.counts[2] + nearest[2] - 1
            sum = real(0.0)
            sum_slope = real(0.0)
            for k in range(3):
                c = real(coefficients[row + k])
                sum += up[k] * c
                sum_slope += up_slope[k] * c
            value += across[i] * along[j] * sum
            gradient[0] += across_slope[i] * along[j] * sum
            gradient[1] += across[i] * along_slope[j] * sum
            gradient[2] += across[i] * along[j] * sum_slope
    gradient /= lattice.spacing
    distance = wp.length(outside)
    if distance > real(0.0):
        for axis in range(3):
            if outside[axis] != real(0.0):
                gradient[axis] = real(0.0)
        gradient += outside / distance
        value += lattice.spacing * distance
    return Vec4(gradient[0], gradient[1], gradient[2], value)


@wp.kernel
def level_set_kernel(
    first_row: wp.int32,
    # Model:
    lattice: LevelSetLattice,
    coefficients: wp.array[float],
    # In:
    points: wp.array[Vec3],
    # Out:
    gradients_out: wp.array[Vec3],
    values_out: wp.array[real],
):
    """Evaluate the level set and its gradient at the points from ``first_row`` on.

    Args:
        first_row: index of the point of the first thread.
        lattice: lattice of the coefficients.
        coefficients: spline coefficients, m.
        points: (n,) m.
        gradients_out: (n,) gradients.
        values_out: (n,) m, values.
    """
    i = first_row + wp.tid()
    value = level_set_value_and_gradient(lattice, coefficients, points[i])
    gradients_out[i] = Vec3(value[0], value[1], value[2])
    values_out[i] = value[3]
