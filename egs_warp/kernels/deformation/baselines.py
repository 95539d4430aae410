"""Baseline deformations of Gaussians by a cage: by the nearest surface triangle, by the gradient at the mean, and by a
small tetrahedron around each Gaussian.

Rotations are unit quaternions w, x, y, z. ``polar_rotations_out`` are the rotations of F. Host code:
``egs_warp/deformation/baselines.py``.
"""

import warp as wp

from egs_warp.kernels.deformation.cage_maps import CageMaps, affine_of, exponential, single, single_matrix
from egs_warp.kernels.deformation.decomposition import rotation_from_quaternion
from egs_warp.kernels.deformation.deformer import write_gaussian
from egs_warp.kernels.deformation.embedding import axes_from_quaternion
from egs_warp.precision import Mat33, Vec3, Vec4, real

wp.set_module_options({"enable_backward": False})


@wp.func
def interpolated(corners: wp.vec4i, weights: Vec4, positions: wp.array[Vec3]) -> Vec3:
    """Return the point with the barycentric ``weights`` in the tetrahedron with the nodes ``corners``; the inverse of
    Eq. (2).
    """
    return (
        weights[0] * positions[corners[0]]
        + weights[1] * positions[corners[1]]
        + weights[2] * positions[corners[2]]
        + weights[3] * positions[corners[3]]
    )


@wp.func
def double(v: wp.vec3) -> Vec3:
    return Vec3(real(v[0]), real(v[1]), real(v[2]))


@wp.func
def local_corner(j: wp.int32) -> Vec3:
    """Return corner j of a regular tetrahedron around the origin: alternate corners of a cube with side 2."""
    one = real(1.0)
    if j == 0:
        return Vec3(one, one, one)
    if j == 1:
        return Vec3(one, -one, -one)
    if j == 2:
        return Vec3(-one, one, -one)
    return Vec3(-one, -one, one)


@wp.func
def local_lengths(log_scales: wp.vec3, reach: real, min_length: real) -> Vec3:
    s = exponential(log_scales)
    return Vec3(
        wp.max(reach * real(s[0]), min_length),
        wp.max(reach * real(s[1]), min_length),
        wp.max(reach * real(s[2]), min_length),
    )


@wp.kernel
def local_tetrahedron_kernel(
    first_row: wp.int32,
    # In:
    means: wp.array[wp.vec3],
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    reach: real,
    min_length: real,
    # Out:
    corners_out: wp.array[Vec3],
):
    """Compute the corners of each Gaussian's own tetrahedron, which is aligned with its axes.

    Args:
        means, rotations, log_scales: the Gaussians at rest.
        reach: size of the tetrahedron in standard deviations.
        min_length: m, lower bound of its size.
        corners_out: (4 n,) m, the corners of Gaussian i are rows 4 i to 4 i + 3.
    """
    row = first_row + wp.tid()
    lengths = local_lengths(log_scales[row], reach, min_length)
    for j in range(4):
        corner = wp.cw_mul(local_corner(j), lengths)
        corners_out[4 * row + j] = double(means[row]) + axes_from_quaternion(rotations[row]) * corner


@wp.kernel
def deform_with_tetrahedron_kernel(
    first_row: wp.int32,
    # In:
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    corners: wp.array[Vec3],
    reach: real,
    min_length: real,
    # Out:
    means_out: wp.array[wp.vec3],
    rotations_out: wp.array[wp.vec4],
    log_scales_out: wp.array[wp.vec3],
    polar_rotations_out: wp.array[wp.vec4],
):
    """Deform each Gaussian by the gradient F of its own tetrahedron, whose corners the cage has deformed (VR-GS,
    two-level embedding).

    Args:
        rotations, log_scales: the Gaussians at rest.
        corners: (4 n,) m, deformed corners of the tetrahedra of ``local_tetrahedron_kernel``.
        reach, min_length: as in ``local_tetrahedron_kernel``.
        means_out, rotations_out, log_scales_out: the deformed Gaussians.
        polar_rotations_out: rotations of F.
    """
    row = first_row + wp.tid()
    lengths = local_lengths(log_scales[row], reach, min_length)
    centre = Vec3()
    moments = Mat33()
    for j in range(4):
        centre += real(0.25) * corners[4 * row + j]
    for j in range(4):
        moments += wp.outer(real(0.25) * (corners[4 * row + j] - centre), local_corner(j))
    one = real(1.0)
    stretched = single_matrix(moments * wp.diag(Vec3(one / lengths[0], one / lengths[1], one / lengths[2])))
    axes = rotation_from_quaternion(rotations[row])
    means_out[row] = single(centre)
    write_gaussian(
        row, stretched, axes, exponential(log_scales[row]), rotations_out, log_scales_out, polar_rotations_out
    )


@wp.kernel
def deform_with_gradient_kernel(
    first_row: wp.int32,
    # In:
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    positions: wp.array[Vec3],
    nodes: wp.array[wp.vec4i],
    weights: wp.array[Vec4],
    tet_from_mean: wp.array[wp.int32],
    cage: CageMaps,
    # Out:
    means_out: wp.array[wp.vec3],
    rotations_out: wp.array[wp.vec4],
    log_scales_out: wp.array[wp.vec3],
    polar_rotations_out: wp.array[wp.vec4],
):
    """Deform each Gaussian by the gradient F of the tetrahedron that contains its mean (PhysGaussian).

    Args:
        rotations, log_scales: the Gaussians at rest.
        positions: (N,) m, nodes of the deformed cage.
        nodes, weights: (n,) nodes of the tetrahedron and barycentric weights of each mean.
        tet_from_mean: (n,) the tetrahedron.
        cage: maps of the deformed cage.
        means_out, rotations_out, log_scales_out: the deformed Gaussians.
        polar_rotations_out: rotations of F.
    """
    row = first_row + wp.tid()
    axes = rotation_from_quaternion(rotations[row])
    means_out[row] = single(interpolated(nodes[row], weights[row], positions))
    stretched = affine_of(cage, tet_from_mean[row]).gradient * axes
    write_gaussian(
        row, stretched, axes, exponential(log_scales[row]), rotations_out, log_scales_out, polar_rotations_out
    )


@wp.func
def triangle_frame(a: Vec3, b: Vec3, c: Vec3) -> Mat33:
    """Return the matrix whose columns are two edges and the unit normal of a triangle."""
    return wp.matrix_from_cols(b - a, c - a, wp.normalize(wp.cross(b - a, c - a)))


@wp.kernel
def deform_with_surface_kernel(
    first_row: wp.int32,
    # In:
    means: wp.array[wp.vec3],
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    rest: wp.array[Vec3],
    positions: wp.array[Vec3],
    faces: wp.array[wp.vec3i],
    face_from_gaussian: wp.array[wp.int32],
    # Out:
    means_out: wp.array[wp.vec3],
    rotations_out: wp.array[wp.vec4],
    log_scales_out: wp.array[wp.vec3],
    polar_rotations_out: wp.array[wp.vec4],
):
    """Deform each Gaussian by the gradient F of the nearest surface triangle, which does not stretch along the
    triangle's normal (SuGaR: Gaussians bound to triangles).

    Args:
        means, rotations, log_scales: the Gaussians at rest.
        rest, positions: (N,) m, nodes of the cage at rest and deformed.
        faces: nodes of the surface triangles.
        face_from_gaussian: (n,) nearest triangle of each Gaussian.
        means_out, rotations_out, log_scales_out: the deformed Gaussians.
        polar_rotations_out: rotations of F.
    """
    row = first_row + wp.tid()
    f = faces[face_from_gaussian[row]]
    before = triangle_frame(rest[f[0]], rest[f[1]], rest[f[2]])
    after = triangle_frame(positions[f[0]], positions[f[1]], positions[f[2]])
    gradient = after * wp.inverse(before)
    axes = rotation_from_quaternion(rotations[row])
    means_out[row] = single(positions[f[0]] + gradient * (double(means[row]) - rest[f[0]]))
    stretched = single_matrix(gradient) * axes
    write_gaussian(
        row, stretched, axes, exponential(log_scales[row]), rotations_out, log_scales_out, polar_rotations_out
    )
