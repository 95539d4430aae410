"""Kernels of the benchmarks: a ray caster, and probes of a device's peak bandwidth and arithmetic."""

import warp as wp

from egs_warp.kernels.deformation.cage_maps import load_row, store_row
from egs_warp.kernels.render.ellipse import ALPHA_CUT, TILE_PIXELS, TRANSMITTANCE_STOP, pixel_of_thread, splat_alpha

wp.set_module_options({"enable_backward": False})

PROBE_STEPS = wp.constant(2048)


@wp.kernel
def hits_kernel(
    # In:
    width: wp.int32,
    height: wp.int32,
    tile_start: wp.array[wp.int32],
    gaussian_from_intersection: wp.array[wp.int32],
    ellipse: wp.array[wp.vec4],
    falloff: wp.array[wp.vec2],
    # Out:
    hits_out: wp.array[wp.int32],
):
    """Count the splats that each pixel blends, which every renderer of the same image must blend."""
    thread = wp.tid()
    pixel = pixel_of_thread(thread, width)
    if pixel[0] >= width or pixel[1] >= height:
        return
    tile = thread / TILE_PIXELS
    passing = wp.float32(1.0)
    hits = wp.int32(0)
    intersection = tile_start[tile]
    end = tile_start[tile + 1]
    while intersection < end:
        g = gaussian_from_intersection[intersection]
        intersection += 1
        alpha = splat_alpha(ellipse[g], falloff[g], pixel)
        if alpha >= ALPHA_CUT:
            passing = passing * (1.0 - alpha)
            hits += 1
            if passing <= TRANSMITTANCE_STOP:
                intersection = end
    hits_out[pixel[1] * width + pixel[0]] = hits


@wp.kernel
def arithmetic_kernel(
    first: wp.int32,
    # In:
    factor: wp.float32,
    # Out:
    sum_out: wp.array[wp.float32],
):
    """Compute eight independent chains of multiply and add, which reach the device's peak arithmetic rate."""
    i = wp.tid() + first
    a = wp.float32(i)
    b = a + 1.0
    c = a + 2.0
    d = a + 3.0
    e = a + 4.0
    f = a + 5.0
    g = a + 6.0
    h = a + 7.0
    for _step in range(PROBE_STEPS):
        a = a * factor + 1.0
        b = b * factor + 1.0
        c = c * factor + 1.0
        d = d * factor + 1.0
        e = e * factor + 1.0
        f = f * factor + 1.0
        g = g * factor + 1.0
        h = h * factor + 1.0
    sum_out[i] = a + b + c + d + e + f + g + h


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    #pragma clang fp contract(fast)
    typedef float f16 __attribute__((ext_vector_type(16)));
    f16 chains[8];
    for (int i = 0; i < 8; ++i) chains[i] = (f16)(float)i;
    const f16 by = factor, one = start;
    for (int step = 0; step < 2048; ++step)
        for (int i = 0; i < 8; ++i) chains[i] = chains[i] * by + one;
    f16 sum = 0.0f;
    for (int i = 0; i < 8; ++i) sum += chains[i];
    float total = 0.0f;
    for (int lane = 0; lane < 16; ++lane) total += sum[lane];
    sum_out.data[row] = total;
#endif
""")
def vector_chains(row: wp.int32, start: wp.float32, factor: wp.float32, sum_out: wp.array[wp.float32]):
    """Compute the chains of ``arithmetic_kernel`` in vectors of sixteen numbers, as compositing on a CPU does."""
    ...


@wp.kernel
def vector_arithmetic_kernel(
    first: wp.int32,
    # In:
    factor: wp.float32,
    # Out:
    sum_out: wp.array[wp.float32],
):
    """Compute eight independent multiply-add chains of sixteen numbers each, which run at the peak rate of one core."""
    i = wp.tid() + first
    vector_chains(i, 1.0, factor, sum_out)


@wp.kernel
def copy_kernel(
    # In:
    source: wp.array[wp.vec4],
    # Out:
    target_out: wp.array[wp.vec4],
):
    """Copy one array, to measure the time of a pure copy."""
    row = wp.tid()
    store_row(target_out, row, load_row(source, row))


LAMP_COUNT = wp.constant(2)
GLOSS_POWER = wp.constant(8.0)


@wp.func
def lamp_direction(lamp: wp.int32) -> wp.vec3:
    """Return the direction towards the lamp, in the axes of the body at rest."""
    if lamp == 0:
        return wp.normalize(wp.vec3(0.5, -0.6, 0.62))
    return wp.normalize(wp.vec3(-0.7, 0.4, 0.3))


@wp.func
def lamp_colour(lamp: wp.int32) -> wp.vec3:
    if lamp == 0:
        return wp.vec3(1.0, 0.92, 0.8)
    return wp.vec3(0.5, 0.65, 0.9)


@wp.kernel
def trace_kernel(
    # In:
    mesh: wp.uint64,
    rest: wp.array[wp.vec3],
    rest_from_world: wp.array[wp.mat33],
    world_from_camera: wp.mat33,
    eye: wp.vec3,
    focal: wp.vec2,
    centre: wp.vec2,
    width: wp.int32,
    samples: wp.int32,
    # Out:
    rest_out: wp.array2d[wp.vec3],
    hit_out: wp.array2d[wp.bool],
    light_out: wp.array2d[wp.vec3],
    gloss_out: wp.array2d[wp.vec3],
):
    """Intersect each sample ray of each pixel with the mesh.

    Outputs are the hit point at rest, the light there, by which the paint is multiplied, and the gloss, which is added
    (Phong). The lamps rotate with each face (``rest_from_world``), because a capture has no lamps, only colours that
    depend on the direction. Faces are two-sided.
    """
    pixel, sample = wp.tid()
    x = float(pixel % width) + (float(sample % samples) + 0.5) / float(samples)
    y = float(pixel // width) + (float(sample // samples) + 0.5) / float(samples)
    ray = wp.normalize(world_from_camera * wp.vec3((x - centre[0]) / focal[0], (y - centre[1]) / focal[1], 1.0))
    hit = wp.mesh_query_ray(mesh, eye, ray, 1.0e6)
    hit_out[pixel, sample] = hit.result
    if hit.result:
        a = rest[wp.mesh_get_index(mesh, 3 * hit.face)]
        b = rest[wp.mesh_get_index(mesh, 3 * hit.face + 1)]
        c = rest[wp.mesh_get_index(mesh, 3 * hit.face + 2)]
        rest_out[pixel, sample] = hit.u * a + hit.v * b + (1.0 - hit.u - hit.v) * c
        towards = -(rest_from_world[hit.face] * ray)
        normal = wp.normalize(wp.cross(b - a, c - a))
        if wp.dot(normal, towards) < 0.0:
            normal = -normal
        light = wp.vec3(0.5, 0.5, 0.5)
        gloss = wp.vec3(0.0, 0.0, 0.0)
        for lamp in range(LAMP_COUNT):
            facing = wp.dot(normal, lamp_direction(lamp))
            if facing > 0.0:
                mirrored = 2.0 * facing * normal - lamp_direction(lamp)
                light += 0.45 * facing * lamp_colour(lamp)
                gloss += 0.45 * wp.pow(wp.max(wp.dot(mirrored, towards), 0.0), GLOSS_POWER) * lamp_colour(lamp)
        light_out[pixel, sample] = light
        gloss_out[pixel, sample] = gloss
