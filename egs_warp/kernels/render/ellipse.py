"""Screen ellipses: constants of the splatting model, the alpha of a splat, and an exact intersection test of ellipse
and tile."""

import math

import warp as wp

wp.set_module_options({"enable_backward": False})

_ALPHA_CUT = 1.0 / 255.0
_ALPHA_LIMIT = 0.999
_TRANSMITTANCE_STOP = 1.0e-4

LOW_PASS = wp.constant(wp.float32(0.3))
"""Variance, in square pixels, that is added to every screen-space covariance."""
ALPHA_CUT = wp.constant(wp.float32(_ALPHA_CUT))
"""Alpha below which a splat does not affect a pixel."""
LOG_255 = wp.constant(wp.float32(-math.log(_ALPHA_CUT)))
ALPHA_LIMIT = wp.constant(wp.float32(_ALPHA_LIMIT))
"""Maximum alpha of one splat; where alpha reaches it, the gradient is zero."""
TRANSMITTANCE_STOP = wp.constant(wp.float32(_TRANSMITTANCE_STOP))
"""Minimum transmittance. A splat that would reduce the transmittance to this value or less is not blended, nor are the
splats behind it."""
TILE = wp.constant(16)
"""Side of a square tile in pixels."""
TILE_PIXELS = wp.constant(256)
SEGMENT = wp.constant(512)
"""Number of a tile's splats for which one block of the backward pass on a GPU sums the gradients; a multiple of 256."""

CUTOFFS_IN_CPP = f"""
    constexpr float LOG_255 = {-math.log(_ALPHA_CUT)}f;
    constexpr float LOG2_255 = {-math.log2(_ALPHA_CUT)}f;
    constexpr float CUT = {_ALPHA_CUT}f;
    constexpr float LIMIT = {_ALPHA_LIMIT}f;
    constexpr float STOP = {_TRANSMITTANCE_STOP}f;
"""
"""C++ definitions of these constants, for compositing."""


@wp.func
def pixel_of_thread(thread: wp.int32, width: wp.int32) -> wp.vec2i:
    """Return the column and row of the pixel of a ``thread``, with ``TILE_PIXELS`` threads per tile. The pixel may lie
    outside the image.
    """
    tile = thread / TILE_PIXELS
    i = thread % TILE_PIXELS
    columns = (width + TILE - 1) / TILE
    return wp.vec2i((tile % columns) * TILE + i % TILE, (tile / columns) * TILE + i / TILE)


@wp.func
def is_tile_enabled(tile_mask: wp.array[wp.int32], tile: wp.int32) -> bool:
    """Return True if ``tile`` is rendered; an empty mask enables all tiles."""
    return tile_mask.shape[0] == 0 or tile_mask[tile] != 0


@wp.func
def splat_alpha(ellipse: wp.vec4, falloff: wp.vec2, pixel: wp.vec2i) -> wp.float32:
    """Return the alpha of one splat at the centre of ``pixel`` (column, row), at most ``ALPHA_LIMIT``."""
    dy = wp.float32(pixel[1]) + 0.5 - ellipse[1]
    u = wp.float32(pixel[0]) + 0.5 - ellipse[0] + ellipse[3] * dy
    return wp.min(wp.exp(falloff[1] - falloff[0] * dy * dy - ellipse[2] * u * u), ALPHA_LIMIT)


@wp.func
def tile_rows(ellipse: wp.vec4, falloff: wp.vec2, height: wp.int32) -> wp.vec2i:
    """Return the first and last tile row with a pixel centre inside the vertical extent of the ellipse; first > last if
    there is none. ``height`` is that of the image.
    """
    reach = wp.sqrt((falloff[1] + LOG_255) / falloff[0])
    first = wp.int32(wp.ceil(wp.max(ellipse[1] - reach - 0.5, 0.0)))
    last = wp.int32(wp.floor(wp.min(ellipse[1] + reach - 0.5, wp.float32(height - 1))))
    if first > last:
        return wp.vec2i(0, -1)
    return wp.vec2i(first / TILE, last / TILE)


@wp.func
def tile_columns(ellipse: wp.vec4, falloff: wp.vec2, row: wp.int32, width: wp.int32, height: wp.int32) -> wp.vec2i:
    """Return the first and last tile column in which the ellipse has points within the tile row ``row``. The test is
    exact, because the ellipse is convex.
    """
    cut = falloff[1] + LOG_255
    top = wp.float32(row * TILE) + 0.5 - ellipse[1]
    bottom = wp.float32(wp.min(row * TILE + TILE, height)) - 0.5 - ellipse[1]
    # The ellipse a (dx + shear dy)^2 + v dy^2 = cut has its leftmost and rightmost points at dy = -+ tip.
    v = falloff[0]
    shear = ellipse[3]
    tip = -shear * wp.sqrt(cut * ellipse[2] / (v * (v + ellipse[2] * shear * shear)))
    dy_right = wp.clamp(tip, top, bottom)
    dy_left = wp.clamp(-tip, top, bottom)
    right = ellipse[0] - shear * dy_right + wp.sqrt(wp.max(cut - v * dy_right * dy_right, 0.0) / ellipse[2])
    left = ellipse[0] - shear * dy_left - wp.sqrt(wp.max(cut - v * dy_left * dy_left, 0.0) / ellipse[2])
    first = wp.int32(wp.ceil(wp.max(left - 0.5, 0.0)))
    last = wp.int32(wp.floor(wp.min(right - 0.5, wp.float32(width - 1))))
    if first > last:
        return wp.vec2i(0, -1)
    return wp.vec2i(first / TILE, last / TILE)
