"""Projection of 3D Gaussians to screen-space ellipses (EWA splatting; Kerbl et al. 2023).

The kernels of the renderer share the arrays of n Gaussians: ``means`` (n,) in world units; ``rotations`` (n,),
quaternions w, x, y, z that need not be normalised; ``log_scales`` (n,), logarithms of the standard deviations;
``opacity_logits`` (n,); and ``sh`` (n, coefficients), spherical harmonics. ``antialiased`` is nonzero to compensate the
opacity for the low-pass. Host code: ``egs_warp/render/projection.py``.
"""

from typing import Any

import warp as wp

from egs_warp.kernels.render.ellipse import LOG_255, LOW_PASS, tile_columns, tile_rows
from egs_warp.kernels.render.spherical_harmonics import sh_sum

wp.set_module_options({"enable_backward": False})


NOT_FINITE = wp.constant(wp.int64(2**36))
"""Tile count that marks a Gaussian with a non-finite value. It is larger than the tile count of any image."""


@wp.struct
class View:
    """Pinhole camera in single precision."""

    rotation: wp.mat33
    translation: wp.vec3
    centre: wp.vec3
    fx: wp.float32
    fy: wp.float32
    cx: wp.float32
    cy: wp.float32
    near: wp.float32
    far: wp.float32
    slope_low: wp.vec2
    slope_high: wp.vec2
    width: wp.int32
    height: wp.int32


@wp.func
def rotation_matrix(q: wp.vec4) -> wp.mat33:
    """Return the rotation matrix of the quaternion ``q`` (w, x, y, z), which is normalised first; the identity for a
    zero quaternion.
    """
    length = wp.length(q)
    w = wp.float32(1.0)
    x = wp.float32(0.0)
    y = wp.float32(0.0)
    z = wp.float32(0.0)
    if length > 0.0:
        w = q[0] / length
        x = q[1] / length
        y = q[2] / length
        z = q[3] / length
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


@wp.func
def scale_of(log_scale: wp.vec3) -> wp.vec3:
    """Return the scales of a Gaussian, the diagonal of S, for their logarithms."""
    return wp.vec3(wp.exp(log_scale[0]), wp.exp(log_scale[1]), wp.exp(log_scale[2]))


@wp.func
def screen_axes(view: View, p: wp.vec3, q: wp.vec4, scale: wp.vec3) -> tuple[wp.vec3, wp.vec3]:
    """Return rows x and y of J W R S, in pixels, at the camera-space point ``p``; the screen covariance is their Gram
    matrix.
    """
    inv_z = 1.0 / p[2]
    # As in gsplat and Kerbl et al., the Jacobian is evaluated at most 15 % outside the image, because it grows without
    # bound farther out.
    tx = wp.clamp(p[0] * inv_z, view.slope_low[0], view.slope_high[0])
    ty = wp.clamp(p[1] * inv_z, view.slope_low[1], view.slope_high[1])
    axes = view.rotation * rotation_matrix(q)
    right = wp.vec3(axes[0, 0], axes[0, 1], axes[0, 2])
    down = wp.vec3(axes[1, 0], axes[1, 1], axes[1, 2])
    forward = wp.vec3(axes[2, 0], axes[2, 1], axes[2, 2])
    row_x = view.fx * inv_z * (right - tx * forward)
    row_y = view.fy * inv_z * (down - ty * forward)
    return wp.cw_mul(row_x, scale), wp.cw_mul(row_y, scale)


@wp.struct
class ScreenCovariance:
    """Screen covariance of one Gaussian, in square pixels. It includes the low-pass, except in the fields whose names
    begin with ``sharp_``.
    """

    sharp_xx: wp.float32
    sharp_yy: wp.float32
    sharp_determinant: wp.float32
    xx: wp.float32
    xy: wp.float32
    yy: wp.float32
    determinant: wp.float32


@wp.func
def screen_covariance(row_x: wp.vec3, row_y: wp.vec3) -> ScreenCovariance:
    """Compute the screen covariance from the rows of ``screen_axes``."""
    covariance = ScreenCovariance()
    covariance.sharp_xx = wp.dot(row_x, row_x)
    covariance.sharp_yy = wp.dot(row_y, row_y)
    covariance.xy = wp.dot(row_x, row_y)
    covariance.xx = covariance.sharp_xx + LOW_PASS
    covariance.yy = covariance.sharp_yy + LOW_PASS
    # By Cauchy-Binet, the determinant is a sum of positive terms, which is accurate where xx yy - xy^2 cancels.
    covariance.sharp_determinant = wp.length_sq(wp.cross(row_x, row_y))
    covariance.determinant = (
        covariance.sharp_determinant + LOW_PASS * (covariance.sharp_xx + covariance.sharp_yy) + LOW_PASS * LOW_PASS
    )
    return covariance


@wp.func
def colour_and_depth(sum: wp.vec3, depth: wp.float32) -> wp.vec4:
    """Return the colour for the SH sum ``sum``, followed by the ``depth``."""
    return wp.vec4(wp.max(sum[0] + 0.5, 0.0), wp.max(sum[1] + 0.5, 0.0), wp.max(sum[2] + 0.5, 0.0), depth)


@wp.func
def view_of(view: View) -> View:
    """Return ``view``."""
    return view


@wp.func
def view_of(view: wp.array[View]) -> View:  # noqa: F811  # pyright: ignore[reportRedeclaration]  # overload
    """Return the only view of an array."""
    return view[0]


@wp.kernel
def project_any_view_kernel(
    first: wp.int32,
    # In:
    view: Any,
    antialiased: wp.int32,
    means: wp.array[wp.vec3],
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    opacity_logits: wp.array[wp.float32],
    sh: wp.array2d[wp.vec3],
    # Out:
    ellipse_out: wp.array[wp.vec4],
    falloff_out: wp.array[wp.vec2],
    colour_depth_out: wp.array[wp.vec4],
    tile_count_out: wp.array[wp.int64],
):
    """Compute the screen ellipse, the falloff and the colour of every Gaussian (CUDA). An invisible Gaussian reaches no
    tile.

    The ellipse is stored in Cholesky form: with u = dx + shear dy, -ln(alpha / opacity) = a u^2 + v dy^2. Its terms are
    all positive, whereas the usual conic suffers from cancellation for long thin splats.

    Args:
        view: camera, or an array (1,) with it, so that a CUDA graph can be replayed with another camera.
        antialiased, means, rotations, log_scales, opacity_logits, sh: as in the module docstring.
        ellipse_out: (n,) centre x and y in pixels, a, and shear.
        falloff_out: (n,) v, and the logarithm of the opacity.
        colour_depth_out: (n,) colour and z-depth.
        tile_count_out: (n,) number of tiles that the ellipse reaches, or ``NOT_FINITE``.
    """
    g = wp.tid() + first
    camera = view_of(view)
    mean = means[g]
    q = rotations[g]
    log_scale = log_scales[g]
    logit = opacity_logits[g]
    tile_count_out[g] = wp.int64(0)
    # -inf is a valid log scale of a flat Gaussian, but the file readers never return one.
    if not (wp.isfinite(mean) and wp.isfinite(q) and wp.isfinite(log_scale) and wp.isfinite(logit)):
        tile_count_out[g] = NOT_FINITE
        return
    p = camera.rotation * mean + camera.translation
    if p[2] < camera.near or p[2] > camera.far:
        return
    row_x, row_y = screen_axes(camera, p, q, scale_of(log_scale))
    screen = screen_covariance(row_x, row_y)
    log_opacity = -wp.log(1.0 + wp.exp(-logit))
    if logit < -15.0:
        log_opacity = logit
    if antialiased != 0:
        log_opacity = log_opacity + 0.5 * wp.log(wp.max(screen.sharp_determinant / screen.determinant, 1.0e-12))
    cut = log_opacity + LOG_255
    # The reach is first compared with the image, which rejects most Gaussians of a large scene.
    if cut <= 0.0 or not wp.isfinite(screen.determinant):
        return
    x = camera.fx * p[0] / p[2] + camera.cx
    y = camera.fy * p[1] / p[2] + camera.cy
    reach_x = wp.sqrt(2.0 * cut * screen.xx)
    reach_y = wp.sqrt(2.0 * cut * screen.yy)
    if x + reach_x < 0.5 or y + reach_y < 0.5:
        return
    if x - reach_x > wp.float32(camera.width) - 0.5 or y - reach_y > wp.float32(camera.height) - 0.5:
        return
    ellipse = wp.vec4(x, y, 0.5 * screen.yy / screen.determinant, -screen.xy / screen.yy)
    falloff = wp.vec2(0.5 / screen.yy, log_opacity)
    rows = tile_rows(ellipse, falloff, camera.height)
    tiles = wp.int32(0)
    for row in range(rows[0], rows[1] + 1):
        span = tile_columns(ellipse, falloff, row, camera.width, camera.height)
        tiles += span[1] - span[0] + 1
    if tiles == 0:
        return
    colour = sh_sum(sh, g, sh.shape[1], wp.normalize(mean - camera.centre))
    if not wp.isfinite(colour):
        tile_count_out[g] = NOT_FINITE
        return
    tile_count_out[g] = wp.int64(tiles)
    ellipse_out[g] = ellipse
    falloff_out[g] = falloff
    colour_depth_out[g] = colour_and_depth(colour, p[2])


project_kernel = wp.overload(project_any_view_kernel, {"view": View})
"""``project_any_view_kernel`` for a ``View``."""
project_into_view_kernel = wp.overload(project_any_view_kernel, {"view": wp.array[View]})
"""``project_any_view_kernel`` for an array (1,) of ``View``."""
