"""Kernels of the backdrop: the ground as one camera sees it, and the object's soft shadow on it.

The kernels of an image have one thread per pixel, those of the shadow map one thread per texel. Lengths are in world
units. Host code: ``egs_warp/render/backdrop.py`` and ``egs_warp/render/shadow.py``.
"""

import warp as wp

from egs_warp.kernels.render.projection import View

wp.set_module_options({"enable_backward": False})

TEXELS = wp.constant(192)
"""Number of texels along a side of the shadow map."""
LAYERS = wp.constant(3)
"""Number of layers of the shadow map; Gaussians are assigned to layers by their height."""
_FIXED_POINT_SCALE = wp.constant(wp.float32(2.0**20))
"""Fixed-point scale of the coverage sums; integer sums do not depend on the order of a GPU's atomic additions."""
_MAX_COVERAGE = wp.constant(wp.float32(1e6))
"""Maximum coverage of one texel by one Gaussian."""
_MIN_GRAZING_SINE = wp.constant(wp.float32(0.05))
"""Minimum sine of the angle between ray and ground in the computation of a pixel's size on the ground."""
_EPSILON = wp.constant(wp.float32(1e-9))


@wp.struct
class Ground:
    """Ground plane, and the disc on it that can be in shadow, in world units."""

    normal: wp.vec3
    first: wp.vec3
    second: wp.vec3
    """Orthogonal unit vectors in the plane, its axes."""
    centre: wp.vec3
    """Centre of the disc."""
    rise: wp.float32
    """Height of the centre above the plane."""
    reach: wp.float32
    """Radius of the disc."""
    slope: wp.vec2
    """Displacement of a shadow along the plane's axes per unit of height above the plane, towards the light; zero for a
    vertical light."""


@wp.struct
class Layers:
    """Height range of the Gaussians of each shadow layer, world units."""

    low: wp.vec3
    high: wp.vec3
    max_opacity: wp.vec3
    """Maximum opacity of each layer."""


@wp.func
def texel_of(ground: Ground, away: wp.vec3) -> wp.vec2:
    """Return the map position, in texels from the map's corner, of the shadow of a point at the offset ``away`` from
    the disc's centre.
    """
    side = 0.5 * wp.float32(TEXELS)
    height = wp.dot(away, ground.normal) + ground.rise
    flat = wp.vec2(wp.dot(away, ground.first), wp.dot(away, ground.second))
    across = (flat - height * ground.slope) / ground.reach
    return wp.vec2((across[0] + 1.0) * side, (across[1] + 1.0) * side)


@wp.kernel
def ground_kernel(
    first_row: wp.int32,
    # In:
    view: View,
    ground: Ground,
    eye: wp.vec3,
    fade_reach: wp.float32,
    surface_depth: wp.array[wp.float32],
    # Out:
    depth_out: wp.array[wp.float32],
    flat_out: wp.array[wp.vec2],
    fade_out: wp.array[wp.float32],
    pixel_out: wp.array[wp.float32],
    lift_out: wp.array[wp.float32],
    texel_out: wp.array[wp.vec2],
):
    """Compute, for every pixel, the point of the ground that it shows.

    Args:
        view: camera.
        ground: plane and disc.
        eye: camera centre relative to the centre of the disc.
        fade_reach: distance from the centre beyond which there is no shadow.
        surface_depth: z-depth of the visible surface, 0 if the visible surface is the plane.
        depth_out: z-depth of the plane, 0 if the ray does not meet it from above.
        flat_out: position on the plane relative to the centre, along its axes.
        fade_out: 1 near the centre, decreasing to 0 at ``fade_reach``.
        pixel_out: size of a pixel on the plane.
        lift_out: height of the visible surface above the plane.
        texel_out: map position of the visible surface's shadow (``texel_of``).
    """
    tid = wp.tid() + first_row
    u = wp.float32(tid % view.width) + 0.5
    v = wp.float32(tid / view.width) + 0.5
    ray = wp.transpose(view.rotation) * wp.vec3((u - view.cx) / view.fx, (v - view.cy) / view.fy, 1.0)
    slope = wp.dot(ray, ground.normal)
    above = wp.dot(eye, ground.normal) + ground.rise
    depth = wp.float32(0.0)
    if slope < -_EPSILON and above > 0.0:
        depth = -above / slope
    place = eye + depth * ray
    flat = wp.vec2(wp.dot(place, ground.first), wp.dot(place, ground.second))
    fade = wp.float32(0.0)
    if depth > 0.0:
        fade = wp.clamp(1.6 - 1.6 * wp.length(flat) / fade_reach, 0.0, 1.0)
    if surface_depth[tid] > 0.0:
        place = eye + surface_depth[tid] * ray
    depth_out[tid] = depth
    flat_out[tid] = flat
    fade_out[tid] = fade
    pixel_out[tid] = wp.max(depth / view.fx / wp.max(-slope / wp.length(ray), _MIN_GRAZING_SINE), _EPSILON)
    lift_out[tid] = wp.dot(place, ground.normal) + ground.rise
    texel_out[tid] = texel_of(ground, place)


@wp.struct
class Studio:
    """Colours of a floor that blends into its surroundings without a visible edge, and of the grid on it."""

    floor: wp.vec3
    """Colour of the floor near the camera."""
    horizon: wp.vec3
    """Colour of the floor far away, and of the sky at the horizon."""
    sky: wp.vec3
    """Colour of the sky where the sine of the elevation is at least ``sky_rise``."""
    line: wp.vec3
    cell: wp.float32
    """Spacing of the fine grid lines, world units."""
    clear_depth: wp.float32
    """z-depth up to which the floor has its own colour. From ``hazy_depth`` on, it has the colour of the horizon."""
    hazy_depth: wp.float32
    sky_rise: wp.float32
    """Sine of the elevation at which the sky's gradient ends."""


@wp.func
def line_strength(across: wp.vec2, cell: wp.float32, pixel: wp.float32) -> wp.float32:
    """Return the strength of a grid at the position ``across``: 1 on its lines, which are ``cell`` apart, and 0 between
    them. Lines that are less than a few pixels apart fade out; ``pixel`` is the size of a pixel on the plane.
    """
    nearest = wp.float32(1e30)
    for axis in range(2):
        cell_position = across[axis] / cell + 0.5
        nearest = wp.min(nearest, wp.abs(cell_position - wp.floor(cell_position) - 0.5) * cell)
    return wp.clamp(1.1 - nearest / pixel, 0.0, 1.0) * wp.clamp(0.2 * cell / pixel - 1.0, 0.0, 1.0)


@wp.kernel
def studio_kernel(
    first_row: wp.int32,
    # In:
    view: View,
    normal: wp.vec3,
    depth: wp.array[wp.float32],
    flat: wp.array[wp.vec2],
    pixel: wp.array[wp.float32],
    studio: Studio,
    # Out:
    colour_out: wp.array[wp.vec3],
):
    """Draw a sky, and a floor that fades into haze. Fine grid lines are ``studio.cell`` apart; every fourth line is
    strong.

    Args:
        view: camera.
        normal: unit normal of the plane.
        depth, flat, pixel: results of ``ground_kernel``.
        studio: colours and grid.
        colour_out: colours of the pixels.
    """
    tid = wp.tid() + first_row
    u = wp.float32(tid % view.width) + 0.5
    v = wp.float32(tid / view.width) + 0.5
    ray = wp.transpose(view.rotation) * wp.vec3((u - view.cx) / view.fx, (v - view.cy) / view.fy, 1.0)
    rise = wp.clamp(wp.dot(ray, normal) / wp.length(ray) / studio.sky_rise, 0.0, 1.0)
    colour = wp.lerp(studio.horizon, studio.sky, rise)
    if depth[tid] > 0.0:
        fine = line_strength(flat[tid], studio.cell, pixel[tid])
        strong = line_strength(flat[tid], 4.0 * studio.cell, pixel[tid])
        floor = wp.lerp(studio.floor, studio.line, wp.max(0.4 * fine, strong))
        haze = wp.clamp((depth[tid] - studio.clear_depth) / (studio.hazy_depth - studio.clear_depth), 0.0, 1.0)
        colour = wp.lerp(floor, studio.horizon, haze * haze * (3.0 - 2.0 * haze))
    colour_out[tid] = colour


@wp.kernel
def coverage_kernel(
    # In:
    ground: Ground,
    layers: Layers,
    means: wp.array[wp.vec3],
    log_scales: wp.array[wp.vec3],
    opacity_logits: wp.array[wp.float32],
    # Out:
    coverage: wp.array3d[wp.int64],
):
    """Add the coverage of each Gaussian to the shadow map. The coverage is the Gaussian's opacity times the area of its
    broadest side, in texels.

    Args:
        ground: plane and disc.
        layers: height ranges of the layers.
        means, log_scales, opacity_logits: (n,) the Gaussians.
        coverage: (layers, rows, columns) sums in fixed point, updated.
    """
    g = wp.tid()
    away = means[g] - ground.centre
    height = wp.max(wp.dot(away, ground.normal) + ground.rise, 0.0)
    texel = texel_of(ground, away)
    row = wp.int32(wp.floor(wp.clamp(texel[1], -1.0, wp.float32(TEXELS))))
    column = wp.int32(wp.floor(wp.clamp(texel[0], -1.0, wp.float32(TEXELS))))
    if row < 0 or row >= TEXELS or column < 0 or column >= TEXELS:
        return
    s = log_scales[g]
    broad = s[0] + s[1] + s[2] - wp.min(s[0], wp.min(s[1], s[2]))
    side = 2.0 * ground.reach / wp.float32(TEXELS)
    area = 2.0 * wp.pi * wp.exp(wp.min(broad, 80.0)) / (side * side)
    amount = wp.min(area / (1.0 + wp.exp(-opacity_logits[g])), _MAX_COVERAGE)
    for layer in range(LAYERS):
        if height >= layers.low[layer] and height < layers.high[layer]:
            wp.atomic_add(coverage, layer, row, column, wp.int64(amount * _FIXED_POINT_SCALE + 0.5))


@wp.kernel
def unpack_coverage_kernel(
    first_row: wp.int32,
    # In:
    coverage: wp.array3d[wp.int64],
    # Out:
    coverage_out: wp.array3d[wp.float32],
):
    """Convert the coverage (layers, rows, columns) from fixed point to floating point."""
    tid = wp.tid() + first_row
    layer = tid / (TEXELS * TEXELS)
    row = (tid / TEXELS) % TEXELS
    column = tid % TEXELS
    coverage_out[layer, row, column] = wp.float32(coverage[layer, row, column]) / _FIXED_POINT_SCALE


@wp.kernel
def occupied_rows_kernel(
    first_row: wp.int32,
    # In:
    source: wp.array3d[wp.float32],
    # Out:
    occupied_out: wp.array[wp.bool],
):
    """Write True for each row of ``source`` (layers, rows, columns) that has a nonzero texel."""
    tid = wp.tid() + first_row
    occupied = wp.bool(False)
    for column in range(TEXELS):
        if source[tid / TEXELS, tid % TEXELS, column] != 0.0:
            occupied = wp.bool(True)
    occupied_out[tid] = occupied


@wp.kernel
def blur_kernel(
    first_row: wp.int32,
    # In:
    source: wp.array3d[wp.float32],
    occupied: wp.array[wp.bool],
    taps: wp.array2d[wp.float32],
    reach: wp.array[wp.int32],
    # Out:
    out: wp.array3d[wp.float32],
):
    """Blur each row and write the transpose, so that two calls blur in both directions.

    Args:
        source: (layers, rows, columns) map.
        occupied: flags of ``occupied_rows_kernel``.
        taps: (layers, taps) weights of each layer, the centre first.
        reach: (layers,) number of taps on each side. Texels outside the map are mirrored at its edge.
        out: (layers, columns, rows) blurred map.
    """
    tid = wp.tid() + first_row
    layer = tid / (TEXELS * TEXELS)
    row = (tid / TEXELS) % TEXELS
    column = tid % TEXELS
    total = taps[layer, 0] * source[layer, row, column]
    row_reach = wp.where(occupied[layer * TEXELS + row], reach[layer], 0)
    for k in range(1, row_reach + 1):
        left = wp.abs(column - k)
        right = column + k
        if right >= TEXELS:
            right = 2 * (TEXELS - 1) - right
        total += taps[layer, k] * (source[layer, row, left] + source[layer, row, right])
    out[layer, column, row] = total


@wp.kernel
def opacity_kernel(
    first_row: wp.int32,
    # In and out:
    layers: wp.array3d[wp.float32],
):
    """Convert the coverage in ``layers`` (layers, rows, columns) to opacity, 1 - exp(-coverage), in place."""
    tid = wp.tid() + first_row
    layer = tid / (TEXELS * TEXELS)
    row = (tid / TEXELS) % TEXELS
    column = tid % TEXELS
    layers[layer, row, column] = 1.0 - wp.exp(-layers[layer, row, column])


@wp.kernel
def combine_layers_kernel(
    first_row: wp.int32,
    # In:
    opacity: wp.array3d[wp.float32],
    max_opacity: wp.vec3,
    # Out:
    shade_out: wp.array2d[wp.float32],
):
    """Combine the layers to one shadow: the transmitted light is the product of the fractions that the layers transmit.

    Args:
        opacity: (layers, rows, columns) opacities.
        max_opacity: maximum opacity of each layer.
        shade_out: (rows, columns) opacity of the shadow.
    """
    tid = wp.tid() + first_row
    row = tid / TEXELS
    column = tid % TEXELS
    passing = wp.float32(1.0)
    for layer in range(LAYERS):
        passing *= 1.0 - opacity[layer, row, column] * max_opacity[layer]
    shade_out[row, column] = 1.0 - passing


@wp.func
def shade_at(shade: wp.array2d[wp.float32], row: wp.int32, column: wp.int32) -> wp.float32:
    """Return the shade of a texel, 0 outside the map."""
    if row < 0 or row >= TEXELS or column < 0 or column >= TEXELS:
        return wp.float32(0.0)
    return shade[row, column]


@wp.kernel
def shadow_opacity_kernel(
    first_row: wp.int32,
    # In:
    shade: wp.array2d[wp.float32],
    texel: wp.array[wp.vec2],
    shift: wp.vec2,
    strength: wp.array[wp.float32],
    # Out:
    shadow_opacity_out: wp.array[wp.float32],
):
    """Compute the shadow's opacity at every pixel by bilinear interpolation of the map, which is displaced by ``shift``
    texels.

    Args:
        shade: (rows, columns) shadow map.
        texel: map position of each pixel.
        shift: displacement of the map, texels.
        strength: factor of the opacity at each pixel.
        shadow_opacity_out: opacity at each pixel.
    """
    tid = wp.tid() + first_row
    cover = wp.float32(0.0)
    if strength[tid] > 0.0:
        u = wp.clamp(texel[tid][0] - shift[0] - 0.5, -2.0, wp.float32(TEXELS) + 1.0)
        v = wp.clamp(texel[tid][1] - shift[1] - 0.5, -2.0, wp.float32(TEXELS) + 1.0)
        column = wp.int32(wp.floor(u))
        row = wp.int32(wp.floor(v))
        right = u - wp.floor(u)
        below = v - wp.floor(v)
        upper = wp.lerp(shade_at(shade, row, column), shade_at(shade, row, column + 1), right)
        lower = wp.lerp(shade_at(shade, row + 1, column), shade_at(shade, row + 1, column + 1), right)
        cover = strength[tid] * wp.lerp(upper, lower, below)
    shadow_opacity_out[tid] = cover


@wp.kernel
def join_covers_kernel(
    first_row: wp.int32,
    # In:
    other: wp.array[wp.float32],
    # In and out:
    cover: wp.array[wp.float32],
):
    """Combine two shadows in place: the transmitted light is the product of the fractions that they transmit."""
    tid = wp.tid() + first_row
    cover[tid] = 1.0 - (1.0 - cover[tid]) * (1.0 - other[tid])


@wp.kernel
def dim_kernel(
    first_row: wp.int32,
    # In:
    unshadowed: wp.array[wp.vec3],
    cover: wp.array[wp.float32],
    # Out:
    colour_out: wp.array[wp.vec3],
):
    """Darken an image by the opacity ``cover`` of the shadow at each pixel."""
    tid = wp.tid() + first_row
    colour_out[tid] = (1.0 - cover[tid]) * unshadowed[tid]
