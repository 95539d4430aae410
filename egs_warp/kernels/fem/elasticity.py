"""Neo-Hookean tetrahedra with objective damping: energy, gradient and Hessian per element, gathered without atomics.

The first dimension of a launch is the world; all worlds share the mesh, the material and the muscles. The kernels share
these arguments, for B worlds, T elements and N nodes:

* ``tets`` (T,): nodes of each element.
* ``rest_inverses`` (T,) 1/m: inverse edge matrices at rest.
* ``volumes`` (T,) m^3: volumes at rest.
* ``mu``, ``lam``: shear modulus and Lame's first parameter, Pa.
* ``damping_time``: Rayleigh coefficient beta, s.
* ``start_gradients`` (B, T): deformation gradients at the start of the step; not read if ``dt`` is 0.
* ``positions`` (B, N) m: nodes at the end of the step.
* ``dt``: step size, s; 0 leaves out the damping.
"""

import warp as wp

from egs_warp.kernels.block import warp_size, warp_sum
from egs_warp.precision import Mat33, Vec3, real

wp.set_module_options({"enable_backward": False})

DIAGONAL_TOLERANCE, MAX_SWEEPS = 1e-31, 12
_DIAGONAL_TOLERANCE = wp.constant(real(DIAGONAL_TOLERANCE))
"""Jacobi's iteration ends when the sum of the squared off-diagonal entries is below this fraction of the
squared trace."""
_MAX_SWEEPS = wp.constant(MAX_SWEEPS)
"""Maximum number of Jacobi sweeps; the iteration converges quadratically, so fewer suffice."""


@wp.func
def deformation_gradient(x: wp.array2d[Vec3], world: int, tet: wp.vec4i, rest_inverse: Mat33) -> Mat33:
    """Return the deformation gradient F of a tetrahedron.

    Args:
        x: (B, N) m, nodes.
        world: index of the world.
        tet: nodes of the tetrahedron.
        rest_inverse: inverse edge matrix at rest, 1/m.
    """
    first = x[world, tet[0]]
    edges = wp.matrix_from_cols(x[world, tet[1]] - first, x[world, tet[2]] - first, x[world, tet[3]] - first)
    return edges * rest_inverse


@wp.func
def shape_gradient(rest_inverse: Mat33, corner: int) -> Vec3:
    """Return the gradient g_a (1/m, at rest) of the shape function of corner a. The deformation gradient is F = sum_a
    x_a g_a^T."""
    if corner == 0:
        return -(rest_inverse[0] + rest_inverse[1] + rest_inverse[2])
    return rest_inverse[corner - 1]


@wp.func
def principal_axes(symmetric: Mat33):
    """Return the eigenvectors (columns of a rotation) and eigenvalues of a symmetric matrix, by Jacobi rotations."""
    m = real(1.0) * symmetric
    axes = wp.identity(n=3, dtype=wp.float64)
    tolerance = _DIAGONAL_TOLERANCE * wp.trace(m) * wp.trace(m)
    sweep = int(0)
    while sweep < _MAX_SWEEPS and m[0, 1] * m[0, 1] + m[0, 2] * m[0, 2] + m[1, 2] * m[1, 2] > tolerance:
        sweep += 1
        for r in range(3):
            p = (r + 1) % 3
            q = (r + 2) % 3
            between = m[p, q]
            if between != real(0.0):
                half = (m[q, q] - m[p, p]) / (real(2.0) * between)
                tangent = real(1.0) / (wp.abs(half) + wp.sqrt(half * half + real(1.0)))
                if half < real(0.0):
                    tangent = -tangent
                c = real(1.0) / wp.sqrt(tangent * tangent + real(1.0))
                s = tangent * c
                m[p, p] = m[p, p] - tangent * between
                m[q, q] = m[q, q] + tangent * between
                m[p, q] = real(0.0)
                m[q, p] = real(0.0)
                first = m[r, p]
                second = m[r, q]
                m[r, p] = c * first - s * second
                m[r, q] = s * first + c * second
                m[p, r] = m[r, p]
                m[q, r] = m[r, q]
                for i in range(3):
                    first = axes[i, p]
                    second = axes[i, q]
                    axes[i, p] = c * first - s * second
                    axes[i, q] = s * first + c * second
    return axes, Vec3(m[0, 0], m[1, 1], m[2, 2])


@wp.func
def damping_stress(start_gradient: Mat33, gradient: Mat33, dt: real, mu: real, lam: real) -> Mat33:
    """Return the damping stress divided by beta, Pa/s.

    The stress is of second Piola-Kirchhoff type, S = 2 mu E' + lambda tr(E') I, with the strain rate E' = (F^T F - F0^T
    F0) / (2 dt) and F0 at the start of the step.
    """
    strain_rate = (wp.transpose(gradient) * gradient - wp.transpose(start_gradient) * start_gradient) / (real(2.0) * dt)
    return real(2.0) * mu * strain_rate + lam * wp.trace(strain_rate) * wp.identity(n=3, dtype=wp.float64)


@wp.func
def damping_block(
    stretch: Mat33, f_a: Vec3, f_b: Vec3, along: real, rotation_term: real, dt: real, mu: real, lam: real
):
    """Return block (a, b) of the Hessian of the damping, divided by beta and the volume: the derivative of F S g_a with
    respect to corner b.

    Args:
        stretch: F F^T.
        f_a: F g_a.
        f_b: F g_b.
        along: g_a.g_b.
        rotation_term: g_a.S g_b, the factor of I that stems from the derivative of F. The other terms stem from the
            derivative of the stress S (``damping_stress``).
        dt: step size, s.
        mu: shear modulus, Pa.
        lam: Lame's first parameter lambda, Pa.
    """
    material = mu * (along * stretch + wp.outer(f_b, f_a)) + lam * wp.outer(f_a, f_b)
    return material / dt + rotation_term * wp.identity(n=3, dtype=wp.float64)


@wp.func
def write_first_corner(world: int, e: int, blocks: wp.array3d[Mat33]):
    """Complete the 4 x 4 ``blocks`` (B, T, 16) of element ``e``: those below the diagonal by symmetry, and those of
    corner 0 from the others.

    By translation invariance the blocks of a row sum to zero.
    """
    last = Mat33()
    for a in range(1, 4):
        row = Mat33()
        for b in range(1, 4):
            if b < a:
                blocks[world, e, 4 * a + b] = wp.transpose(blocks[world, e, 4 * b + a])
            row -= blocks[world, e, 4 * a + b]
        blocks[world, e, 4 * a] = row
        blocks[world, e, a] = wp.transpose(row)
        last -= row
    blocks[world, e, 0] = last


@wp.kernel
def deformation_gradients_kernel(
    # Model:
    tets: wp.array[wp.vec4i],
    rest_inverses: wp.array[Mat33],
    # In:
    positions: wp.array2d[Vec3],
    # Out:
    gradients_out: wp.array2d[Mat33],
):
    """Compute the deformation gradients ``gradients_out`` (B, T) of all elements."""
    world, e = wp.tid()
    gradients_out[world, e] = deformation_gradient(positions, world, tets[e], rest_inverses[e])


@wp.kernel
def element_energies_kernel(
    # Model:
    tets: wp.array[wp.vec4i],
    rest_inverses: wp.array[Mat33],
    volumes: wp.array[real],
    mu: real,
    lam: real,
    damping_time: real,
    # In:
    start_gradients: wp.array2d[Mat33],
    positions: wp.array2d[Vec3],
    dt: real,
    # Out:
    energies_out: wp.array2d[real],
    determinants_out: wp.array2d[real],
):
    """Compute the energy and det F of each element.

    The energy is that of Eq. (5) plus dt times half the dissipated power. It is infinite for an inverted element. The
    outputs are ``energies_out`` (B, T) in joules and ``determinants_out`` (B, T).
    """
    world, e = wp.tid()
    f = deformation_gradient(positions, world, tets[e], rest_inverses[e])
    j = wp.determinant(f)
    determinants_out[world, e] = j
    if j <= real(0.0):
        energies_out[world, e] = real(wp.inf)
    else:
        log_j = wp.log(j)
        density = real(0.5) * mu * (wp.ddot(f, f) - real(3.0)) - mu * log_j + real(0.5) * lam * log_j * log_j
        if dt > real(0.0):
            f0 = start_gradients[world, e]
            stress = damping_stress(f0, f, dt, mu, lam)
            strain = real(0.5) * (wp.transpose(f) * f - wp.transpose(f0) * f0)
            density += real(0.5) * damping_time * wp.ddot(strain, stress)
        energies_out[world, e] = volumes[e] * density


@wp.kernel
def element_gradients_kernel(
    # Model:
    tets: wp.array[wp.vec4i],
    rest_inverses: wp.array[Mat33],
    volumes: wp.array[real],
    mu: real,
    lam: real,
    damping_time: real,
    # In:
    start_gradients: wp.array2d[Mat33],
    positions: wp.array2d[Vec3],
    dt: real,
    # Out:
    corner_gradients_out: wp.array3d[Vec3],
):
    """Compute the gradient of each element's energy with respect to its corners, ``corner_gradients_out`` (B, T, 4) in
    newtons. The gradient is minus the elastic and damping force on the corner."""
    world, e = wp.tid()
    f = deformation_gradient(positions, world, tets[e], rest_inverses[e])
    inverse_transpose = wp.transpose(wp.inverse(f))
    log_j = wp.log(wp.determinant(f))
    stress = mu * (f - inverse_transpose) + lam * log_j * inverse_transpose
    if dt > real(0.0):
        stress += damping_time * (f * damping_stress(start_gradients[world, e], f, dt, mu, lam))
    for a in range(4):
        corner_gradients_out[world, e, a] = volumes[e] * (stress * shape_gradient(rest_inverses[e], a))


@wp.func
def sum_lanes(part: Vec3) -> Vec3:
    """Return the sum of ``part`` over the threads of a warp."""
    return Vec3(warp_sum(part[0]), warp_sum(part[1]), warp_sum(part[2]))


@wp.kernel
def segment_forces_kernel(
    # Model:
    offsets: wp.array[int],
    nodes: wp.array[int],
    weights: wp.array[real],
    rest_lengths: wp.array[real],
    length_zero_force: real,
    length_full_force: real,
    # In:
    tensions: wp.array2d[real],
    positions: wp.array2d[Vec3],
    # Out:
    forces_out: wp.array2d[Vec3],
):
    """Compute the force T phi u of each muscle segment (Eq. 7), with phi as in ``muscles.tension.force_length_factor``.

    A warp computes each segment of each world; on a CPU, one thread.

    Args:
        offsets: (M + 1,) offset of each segment in ``nodes`` and ``weights``.
        nodes: nodes of each segment.
        weights: weights of these nodes; the segment vector is the weighted sum of their positions.
        rest_lengths: (M,) m.
        length_zero_force: relative length at and below which a segment exerts no force.
        length_full_force: relative length at and above which a segment exerts its full tension.
        tensions: (B, M) newtons.
        positions: (B, N) m, nodes.
        forces_out: (B, M) newtons, along the segment vectors.
    """
    world, segment, lane = wp.tid()
    vector = Vec3(real(0.0))
    for slot in range(offsets[segment] + lane, offsets[segment + 1], warp_size()):
        vector += weights[slot] * positions[world, nodes[slot]]
    vector = sum_lanes(vector)
    length = wp.max(wp.length(vector), real(1e-300))
    along = wp.clamp(
        (length / rest_lengths[segment] - length_zero_force) / (length_full_force - length_zero_force),
        real(0.0),
        real(1.0),
    )
    length_factor = along * along * (real(3.0) - real(2.0) * along)
    if lane == 0:
        forces_out[world, segment] = (tensions[world, segment] * length_factor / length) * vector


@wp.kernel
def gather_forces_kernel(
    # Model:
    corner_offsets: wp.array[int],
    corner_from_slot: wp.array[int],
    end_offsets: wp.array[int],
    segment_from_end: wp.array[int],
    end_weights: wp.array[real],
    # In:
    corner_values: wp.array3d[Vec3],
    forces: wp.array2d[Vec3],
    # Out:
    node_values_out: wp.array2d[Vec3],
):
    """Sum the gradients of each node's corners and, if there are muscles, the forces of its segment ends.

    A warp computes each node of each world; on a CPU, one thread.

    Args:
        corner_offsets: (N + 1,) offset of each node in ``corner_from_slot``.
        corner_from_slot: corners of each node; corner c of element e has the index 4 e + c.
        end_offsets: (N + 1,) offset of each node in the next two arrays; empty without muscles.
        segment_from_end: muscle segments of each node.
        end_weights: weights of the node in these segments.
        corner_values: (B, T, 4) newtons, gradients of the elements.
        forces: (B, M) newtons, forces of the segments.
        node_values_out: (B, N) newtons, sums.
    """
    world, node, lane = wp.tid()
    total = Vec3(real(0.0))
    for slot in range(corner_offsets[node] + lane, corner_offsets[node + 1], warp_size()):
        corner = corner_from_slot[slot]
        total += corner_values[world, corner // 4, corner % 4]
    if end_offsets.shape[0] > 0:
        for slot in range(end_offsets[node] + lane, end_offsets[node + 1], warp_size()):
            total += end_weights[slot] * forces[world, segment_from_end[slot]]
    total = sum_lanes(total)
    if lane == 0:
        node_values_out[world, node] = total


@wp.kernel
def element_hessians_kernel(
    # Model:
    tets: wp.array[wp.vec4i],
    rest_inverses: wp.array[Mat33],
    volumes: wp.array[real],
    mu: real,
    lam: real,
    damping_time: real,
    # In:
    start_gradients: wp.array2d[Mat33],
    positions: wp.array2d[Vec3],
    dt: real,
    # Out:
    blocks_out: wp.array3d[Mat33],
):
    """Compute the Hessian of the energy of each element, ``blocks_out`` (B, T, 16) in N/m: block (a, b) has the index 4
    a + b.

    For Eq. (5), block (a, b) is V [mu g_a.g_b I + (mu - lambda ln J) h_b h_a^T + lambda h_a h_b^T] with h = F^-T g. If
    dt is not 0, the Hessian of the damping (Eq. 6) over a step of dt seconds is added.
    """
    world, e = wp.tid()
    rest_inverse = rest_inverses[e]
    f = deformation_gradient(positions, world, tets[e], rest_inverse)
    inverse_transpose = wp.transpose(wp.inverse(f))
    cross_term = mu - lam * wp.log(wp.determinant(f))
    stress = Mat33()
    if dt > real(0.0):
        stress = damping_stress(start_gradients[world, e], f, dt, mu, lam)
    stretch = f * wp.transpose(f)
    for a in range(1, 4):
        g_a = shape_gradient(rest_inverse, a)
        h_a = inverse_transpose * g_a
        f_a = f * g_a
        for b in range(a, 4):
            g_b = shape_gradient(rest_inverse, b)
            h_b = inverse_transpose * g_b
            along = wp.dot(g_a, g_b)
            block = (
                mu * along * wp.identity(n=3, dtype=wp.float64)
                + cross_term * wp.outer(h_b, h_a)
                + lam * wp.outer(h_a, h_b)
            )
            if dt > real(0.0):
                rotation_term = wp.dot(g_a, stress * g_b)
                block += damping_time * damping_block(stretch, f_a, f * g_b, along, rotation_term, dt, mu, lam)
            blocks_out[world, e, 4 * a + b] = volumes[e] * block
    write_first_corner(world, e, blocks_out)


@wp.kernel
def element_projected_hessians_kernel(
    # Model:
    tets: wp.array[wp.vec4i],
    rest_inverses: wp.array[Mat33],
    volumes: wp.array[real],
    mu: real,
    lam: real,
    damping_time: real,
    # In:
    start_gradients: wp.array2d[Mat33],
    positions: wp.array2d[Vec3],
    dt: real,
    # Out:
    blocks_out: wp.array3d[Mat33],
):
    """Compute element Hessians whose negative eigenvalues are set to zero, ``blocks_out`` (B, T, 16) in N/m, from the
    eigensystem of an isotropic energy.

    In the frames of F = U diag(s) V^T the Hessian splits into the 3 x 3 block d2Psi/ds_i ds_j and, for each pair i < k,
    a twist eigenvalue (Psi_i + Psi_k)/(s_i + s_k) and a flip eigenvalue (Psi_i - Psi_k)/(s_i - s_k) (Smith, de Goes,
    Kim 2019). For Eq. (5) these are mu + (lambda ln J - mu)/(s_i s_k) and mu - (lambda ln J - mu)/(s_i s_k). Of the
    damping, only the semi-definite part is added, without the term from the derivative of F.
    """
    world, e = wp.tid()
    rest_inverse = rest_inverses[e]
    f = deformation_gradient(positions, world, tets[e], rest_inverse)
    v, squares = principal_axes(wp.transpose(f) * f)
    s = Vec3(wp.sqrt(squares[0]), wp.sqrt(squares[1]), wp.sqrt(squares[2]))
    u = f * v * wp.diag(Vec3(real(1.0) / s[0], real(1.0) / s[1], real(1.0) / s[2]))
    pressure = lam * wp.log(wp.determinant(f)) - mu
    scaling = Mat33()
    direct = Mat33()
    swapped = Mat33()
    for i in range(3):
        scaling[i, i] = mu + (lam - pressure) / (s[i] * s[i])
        for k in range(3):
            if i != k:
                scaling[i, k] = lam / (s[i] * s[k])
                twist = wp.max(mu + pressure / (s[i] * s[k]), real(0.0))
                flip = wp.max(mu - pressure / (s[i] * s[k]), real(0.0))
                direct[i, k] = real(0.5) * (twist + flip)
                swapped[i, k] = real(0.5) * (flip - twist)
    q, d = principal_axes(scaling)
    clamped = wp.diag(Vec3(wp.max(d[0], real(0.0)), wp.max(d[1], real(0.0)), wp.max(d[2], real(0.0))))
    scaling = q * clamped * wp.transpose(q)
    stretch = f * wp.transpose(f)
    for a in range(1, 4):
        rest_a = shape_gradient(rest_inverse, a)
        g_a = wp.transpose(v) * rest_a
        for b in range(a, 4):
            rest_b = shape_gradient(rest_inverse, b)
            g_b = wp.transpose(v) * rest_b
            block = Mat33()
            for i in range(3):
                block[i, i] += scaling[i, i] * g_a[i] * g_b[i]
                for k in range(3):
                    if i != k:
                        block[i, i] += direct[i, k] * g_a[k] * g_b[k]
                        block[i, k] += scaling[i, k] * g_a[i] * g_b[k] + swapped[i, k] * g_a[k] * g_b[i]
            block = u * block * wp.transpose(u)
            if dt > real(0.0):
                along = wp.dot(rest_a, rest_b)
                block += damping_time * damping_block(stretch, f * rest_a, f * rest_b, along, real(0.0), dt, mu, lam)
            blocks_out[world, e, 4 * a + b] = volumes[e] * block
    write_first_corner(world, e, blocks_out)


@wp.kernel
def gather_matrix_kernel(
    # Model:
    contribution_offsets: wp.array[int],
    block_from_contribution: wp.array[int],
    entry_from_block: wp.array2d[int],
    # In:
    blocks: wp.array3d[Mat33],
    factor: real,
    # Out:
    entries_out: wp.array2d[real],
):
    """Compute the upper entries of ``factor`` times the assembled Hessian; one thread per world and 3 x 3 block.

    Args:
        contribution_offsets: offset of each assembled block in ``block_from_contribution``.
        block_from_contribution: element blocks that sum to each assembled block; block i of element e has the index 16
            e + i.
        entry_from_block: (assembled blocks, 9) matrix entry of each component of a block, row by row; -1 below the
            diagonal.
        blocks: (B, T, 16) N/m, blocks of the elements.
        factor: factor of the result.
        entries_out: (B, nnz) upper entries.
    """
    world, block_index = wp.tid()
    total = Mat33()
    for slot in range(contribution_offsets[block_index], contribution_offsets[block_index + 1]):
        source = block_from_contribution[slot]
        total += factor * blocks[world, source // 16, source % 16]
    for i in range(3):
        for k in range(3):
            entry = entry_from_block[block_index, 3 * i + k]
            if entry >= 0:
                entries_out[world, entry] = total[i, k]
