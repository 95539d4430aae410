"""What is behind a moving object: the ground as one camera sees it, and the object's soft shadow on it."""

import warp as wp

from egs_warp.kernels.render.projection import View

wp.set_module_options({"enable_backward": False})

TEXELS = wp.constant(192)
"""Along a side of the map of the shadow."""
LAYERS = wp.constant(3)
"""Of what casts it, by height."""
_FIXED = wp.constant(wp.float32(2.0**20))
"""Hidden shares are summed as whole numbers of this fineness: in whatever order a GPU adds them, the sum is the same.
"""
_MOST_HIDDEN = wp.constant(wp.float32(1e6))
"""Of one texel by one Gaussian."""
_FLATTEST = wp.constant(wp.float32(0.05))
"""Sine of the angle at which a ray meets the ground, below which a pixel is taken for no longer."""
_SHORTEST = wp.constant(wp.float32(1e-9))


@wp.struct
class Ground:
    """A plane, and which part of it matters. World units."""

    normal: wp.vec3
    first: wp.vec3
    second: wp.vec3
    """Unit vectors along it."""
    centre: wp.vec3
    """Of the part that matters."""
    rise: wp.float32
    """Height of the centre over the plane."""
    reach: wp.float32
    """From the centre to where that part ends."""


@wp.struct
class Layers:
    """Heights between which Gaussians cast one layer of the shadow each, world units."""

    low: wp.vec3
    high: wp.vec3
    paleness: wp.vec3
    """How dark each layer may be."""


@wp.func
def texel_of(ground: Ground, away: wp.vec3) -> wp.vec2:
    """Where on the map lies what is straight below a point ``away`` from the centre, in texels from its corner."""
    side = 0.5 * wp.float32(TEXELS)
    across = wp.vec2(wp.dot(away, ground.first), wp.dot(away, ground.second)) / ground.reach
    return wp.vec2((across[0] + 1.0) * side, (across[1] + 1.0) * side)


@wp.kernel
def ground_kernel(
    first_row: wp.int32,
    # In:
    view: View,
    ground: Ground,
    eye: wp.vec3,
    seen: wp.array[wp.float32],
    # Out:
    depth_out: wp.array[wp.float32],
    flat_out: wp.array[wp.vec2],
    fade_out: wp.array[wp.float32],
    pixel_out: wp.array[wp.float32],
    lift_out: wp.array[wp.float32],
    texel_out: wp.array[wp.vec2],
):
    """Of every pixel, with the camera ``eye`` from the centre: z-depth of the plane, 0 where its ray does not meet it
    from above; where that is, along the plane from the centre; how much of it shows, 1 at the centre and 0 from
    ``reach`` on; the size of a pixel there; and height over the plane and place on the map of what is ``seen`` at a
    z-depth, of the plane where that is 0."""
    tid = wp.tid() + first_row
    u = wp.float32(tid % view.width) + 0.5
    v = wp.float32(tid / view.width) + 0.5
    ray = wp.transpose(view.rotation) * wp.vec3((u - view.cx) / view.fx, (v - view.cy) / view.fy, 1.0)
    slope = wp.dot(ray, ground.normal)
    above = wp.dot(eye, ground.normal) + ground.rise
    depth = wp.float32(0.0)
    if slope < -_SHORTEST and above > 0.0:
        depth = -above / slope
    place = eye + depth * ray
    flat = wp.vec2(wp.dot(place, ground.first), wp.dot(place, ground.second))
    fade = wp.float32(0.0)
    if depth > 0.0:
        fade = wp.clamp(1.6 - 1.6 * wp.length(flat) / ground.reach, 0.0, 1.0)
    if seen[tid] > 0.0:
        place = eye + seen[tid] * ray
    depth_out[tid] = depth
    flat_out[tid] = flat
    fade_out[tid] = fade
    pixel_out[tid] = wp.max(depth / view.fx / wp.max(-slope / wp.length(ray), _FLATTEST), _SHORTEST)
    lift_out[tid] = wp.dot(place, ground.normal) + ground.rise
    texel_out[tid] = texel_of(ground, place)


@wp.kernel
def grid_kernel(
    first_row: wp.int32,
    # In:
    flat: wp.array[wp.vec2],
    pixel: wp.array[wp.float32],
    fade: wp.array[wp.float32],
    cell: wp.float32,
    sky: wp.vec3,
    floor: wp.vec3,
    line: wp.vec3,
    # Out:
    colour_out: wp.array[wp.vec3],
):
    """A floor with lines ``cell`` apart that fades into the sky."""
    tid = wp.tid() + first_row
    across = flat[tid]
    nearest = wp.float32(1e30)
    for axis in range(2):
        share = across[axis] / cell + 0.5
        nearest = wp.min(nearest, wp.abs(share - wp.floor(share) - 0.5) * cell)
    on_line = wp.clamp(1.0 - nearest / (1.2 * pixel[tid]), 0.0, 1.0)
    colour = floor + on_line * (line - floor)
    colour_out[tid] = sky + fade[tid] * (colour - sky)


@wp.kernel
def hide_ground_kernel(
    # In:
    ground: Ground,
    layers: Layers,
    means: wp.array[wp.vec3],
    log_scales: wp.array[wp.vec3],
    opacity_logits: wp.array[wp.float32],
    # Out:
    hidden: wp.array3d[wp.int64],
):
    """Each Gaussian hides as much of its texel as its opacity and its broad side say; (layers, rows, columns)."""
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
    share = wp.min(area / (1.0 + wp.exp(-opacity_logits[g])), _MOST_HIDDEN)
    for layer in range(LAYERS):
        if height >= layers.low[layer] and height < layers.high[layer]:
            wp.atomic_add(hidden, layer, row, column, wp.int64(share * _FIXED + 0.5))


@wp.kernel
def hidden_shares_kernel(
    first_row: wp.int32,
    # In:
    hidden: wp.array3d[wp.int64],
    # Out:
    share_out: wp.array3d[wp.float32],
):
    """Back from whole numbers."""
    tid = wp.tid() + first_row
    layer = tid / (TEXELS * TEXELS)
    row = (tid / TEXELS) % TEXELS
    column = tid % TEXELS
    share_out[layer, row, column] = wp.float32(hidden[layer, row, column]) / _FIXED


@wp.kernel
def occupied_rows_kernel(
    first_row: wp.int32,
    # In:
    source: wp.array3d[wp.float32],
    # Out:
    occupied_out: wp.array[wp.bool],
):
    """Whether a row of a layer has anything in it."""
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
    """Along columns, written the other way round, so that twice makes a blur in both directions: each layer by its
    ``taps``, that of the middle first, as far as it ``reach``es. What lies beyond the rim is mirrored."""
    tid = wp.tid() + first_row
    layer = tid / (TEXELS * TEXELS)
    row = (tid / TEXELS) % TEXELS
    column = tid % TEXELS
    total = taps[layer, 0] * source[layer, row, column]
    furthest = wp.where(occupied[layer * TEXELS + row], reach[layer], 0)
    for k in range(1, furthest + 1):
        left = wp.abs(column - k)
        right = column + k
        if right >= TEXELS:
            right = 2 * (TEXELS - 1) - right
        total += taps[layer, k] * (source[layer, row, left] + source[layer, row, right])
    out[layer, column, row] = total


@wp.kernel
def covered_kernel(
    first_row: wp.int32,
    # In and out:
    layers: wp.array3d[wp.float32],
):
    """What is hidden many times over is covered once."""
    tid = wp.tid() + first_row
    layer = tid / (TEXELS * TEXELS)
    row = (tid / TEXELS) % TEXELS
    column = tid % TEXELS
    layers[layer, row, column] = 1.0 - wp.exp(-layers[layer, row, column])


@wp.kernel
def darkest_kernel(
    first_row: wp.int32,
    # In:
    covered: wp.array3d[wp.float32],
    paleness: wp.vec3,
    # Out:
    shade_out: wp.array2d[wp.float32],
):
    """The darkest of the layers."""
    tid = wp.tid() + first_row
    row = tid / TEXELS
    column = tid % TEXELS
    shade = wp.float32(0.0)
    for layer in range(LAYERS):
        shade = wp.max(shade, covered[layer, row, column] * paleness[layer])
    shade_out[row, column] = shade


@wp.func
def shade_at(shade: wp.array2d[wp.float32], row: wp.int32, column: wp.int32) -> wp.float32:
    """0 beyond the map."""
    if row < 0 or row >= TEXELS or column < 0 or column >= TEXELS:
        return wp.float32(0.0)
    return shade[row, column]


@wp.kernel
def cover_kernel(
    first_row: wp.int32,
    # In:
    shade: wp.array2d[wp.float32],
    texel: wp.array[wp.vec2],
    strength: wp.array[wp.float32],
    # Out:
    cover_out: wp.array[wp.float32],
):
    """How much of the light the shadow takes from every pixel, between the middles of four texels."""
    tid = wp.tid() + first_row
    cover = wp.float32(0.0)
    if strength[tid] > 0.0:
        u = wp.clamp(texel[tid][0] - 0.5, -2.0, wp.float32(TEXELS) + 1.0)
        v = wp.clamp(texel[tid][1] - 0.5, -2.0, wp.float32(TEXELS) + 1.0)
        column = wp.int32(wp.floor(u))
        row = wp.int32(wp.floor(v))
        right = u - wp.floor(u)
        below = v - wp.floor(v)
        upper = wp.lerp(shade_at(shade, row, column), shade_at(shade, row, column + 1), right)
        lower = wp.lerp(shade_at(shade, row + 1, column), shade_at(shade, row + 1, column + 1), right)
        cover = strength[tid] * wp.lerp(upper, lower, below)
    cover_out[tid] = cover


@wp.kernel
def dim_kernel(
    first_row: wp.int32,
    # In:
    bare: wp.array[wp.vec3],
    cover: wp.array[wp.float32],
    # Out:
    colour_out: wp.array[wp.vec3],
):
    """A picture with the shadow on it."""
    tid = wp.tid() + first_row
    colour_out[tid] = (1.0 - cover[tid]) * bare[tid]
