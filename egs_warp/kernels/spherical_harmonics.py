"""Rotate the colour of Gaussians: real spherical harmonics of bands 1 to 3 in the INRIA sign convention.

A band of 2l+1 coefficients is fixed by its values in 2l+1 directions d_i. The turned function is f'(d) = f(Q^T d), so
its coefficients are A^-1 B c, where row i of A holds the band's basis in d_i and row i of B in Q^T d_i; A^-1 is constant.
"""

import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False})

Vec5 = wp.types.vector(length=5, dtype=wp.float32)
Vec7 = wp.types.vector(length=7, dtype=wp.float32)
Mat55 = wp.types.matrix(shape=(5, 5), dtype=wp.float32)
Mat77 = wp.types.matrix(shape=(7, 7), dtype=wp.float32)
Mat73 = wp.types.matrix(shape=(7, 3), dtype=wp.float32)


@wp.func
def band_2(d: wp.vec3) -> Vec5:
    """The five basis functions of band 2 in the unit direction ``d``."""
    x = d[0]
    y = d[1]
    z = d[2]
    return Vec5(
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2.0 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (x * x - y * y),
    )


@wp.func
def band_3(d: wp.vec3) -> Vec7:
    """The seven basis functions of band 3 in the unit direction ``d``."""
    x = d[0]
    y = d[1]
    z = d[2]
    xx = x * x
    yy = y * y
    zz = z * z
    return Vec7(
        -0.5900435899266435 * y * (3.0 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4.0 * zz - xx - yy),
        0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -0.4570457994644658 * x * (4.0 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3.0 * yy),
    )


def _basis(degree: int, d: np.ndarray) -> np.ndarray:
    """(P, 2 degree + 1) basis values for directions (P, 3)."""
    x, y, z = d.T
    if degree == 2:
        return np.stack(
            [
                1.0925484305920792 * x * y,
                -1.0925484305920792 * y * z,
                0.31539156525252005 * (2 * z * z - x * x - y * y),
                -1.0925484305920792 * x * z,
                0.5462742152960396 * (x * x - y * y),
            ],
            axis=1,
        )
    return np.stack(
        [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
            0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ],
        axis=1,
    )


def _well_spread_directions() -> np.ndarray:
    """(7, 3) unit directions; of 4000 seeded sets, the one that conditions bands 2 (its first five) and 3 best."""
    rng = np.random.default_rng(0)
    sets = rng.normal(size=(4000, 7, 3))
    sets /= np.linalg.norm(sets, axis=2, keepdims=True)
    second = _basis(2, sets[:, :5].reshape(-1, 3)).reshape(-1, 5, 5)
    third = _basis(3, sets.reshape(-1, 3)).reshape(-1, 7, 7)
    return sets[np.argmin(np.maximum(np.linalg.cond(second), np.linalg.cond(third)))]


_DIRECTIONS = _well_spread_directions()
DIRECTIONS = wp.constant(Mat73(*_DIRECTIONS.ravel()))
BAND_2_FROM_VALUES = wp.constant(Mat55(*np.linalg.inv(_basis(2, _DIRECTIONS[:5])).ravel()))
BAND_3_FROM_VALUES = wp.constant(Mat77(*np.linalg.inv(_basis(3, _DIRECTIONS)).ravel()))


@wp.kernel
def rotate_sh_kernel(
    first_row: wp.int32,
    # In:
    turns: wp.array[wp.mat33],
    sh: wp.array2d[wp.vec3],
    degree: wp.int32,
    # Out:
    sh_out: wp.array2d[wp.vec3],
):
    """Coefficients of each Gaussian's colour after the rotation ``turns``; band 0 is left alone."""
    row = first_row + wp.tid()
    turn = turns[row]
    back = wp.transpose(turn)
    if degree >= 1:
        # Band 1 is the linear function w.d with w = (-c3, -c1, c2).
        x = -sh[row, 3]
        y = -sh[row, 1]
        z = sh[row, 2]
        sh_out[row, 3] = -(turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z)
        sh_out[row, 1] = -(turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z)
        sh_out[row, 2] = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z
    if degree >= 2:
        # Each coefficient is read once: a row is 192 bytes, and neighbouring threads share no cache line.
        red2 = Vec5()
        green2 = Vec5()
        blue2 = Vec5()
        for j in range(5):
            c2 = sh[row, 4 + j]
            red2[j] = c2[0]
            green2[j] = c2[1]
            blue2[j] = c2[2]
        values_red = Vec5()
        values_green = Vec5()
        values_blue = Vec5()
        for i in range(5):
            basis = band_2(back * wp.vec3(DIRECTIONS[i, 0], DIRECTIONS[i, 1], DIRECTIONS[i, 2]))
            values_red[i] = wp.dot(basis, red2)
            values_green[i] = wp.dot(basis, green2)
            values_blue[i] = wp.dot(basis, blue2)
        red2 = BAND_2_FROM_VALUES * values_red
        green2 = BAND_2_FROM_VALUES * values_green
        blue2 = BAND_2_FROM_VALUES * values_blue
        for j in range(5):
            sh_out[row, 4 + j] = wp.vec3(red2[j], green2[j], blue2[j])
    if degree >= 3:
        red3 = Vec7()
        green3 = Vec7()
        blue3 = Vec7()
        for j in range(7):
            c3 = sh[row, 9 + j]
            red3[j] = c3[0]
            green3[j] = c3[1]
            blue3[j] = c3[2]
        values3_red = Vec7()
        values3_green = Vec7()
        values3_blue = Vec7()
        for i in range(7):
            basis3 = band_3(back * wp.vec3(DIRECTIONS[i, 0], DIRECTIONS[i, 1], DIRECTIONS[i, 2]))
            values3_red[i] = wp.dot(basis3, red3)
            values3_green[i] = wp.dot(basis3, green3)
            values3_blue[i] = wp.dot(basis3, blue3)
        red3 = BAND_3_FROM_VALUES * values3_red
        green3 = BAND_3_FROM_VALUES * values3_green
        blue3 = BAND_3_FROM_VALUES * values3_blue
        for j in range(7):
            sh_out[row, 9 + j] = wp.vec3(red3[j], green3[j], blue3[j])
