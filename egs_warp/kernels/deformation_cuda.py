"""Eq. (14), (15) and the turn of degree 3 colour on CUDA: one thread a Gaussian, one pass over memory.

Rows of colour are 192 bytes long. A warp moves its 32 rows through shared memory in whole 16-byte pieces, side by side:
read row by row, every load would touch 32 cache lines. CUDA C++ only for that; the mathematics is that of the CPU.
"""

import warp as wp

from egs_warp.kernels.carried_cage import load_row, store_row
from egs_warp.kernels.deformation import carried_gaussian
from egs_warp.kernels.spherical_harmonics import Mat53, Mat73, turned_band_1, turned_band_2, turned_band_3

wp.set_module_options({"enable_backward": False, "fast_math": True})

BLOCK = 128
Row = wp.types.vector(length=48, dtype=wp.float32)


@wp.func_native("""
    // 13 float4 a row: an odd stride keeps both ways of access free of bank conflicts.
    __shared__ float4 space[128 * 13];
    return reinterpret_cast<uint64_t>(space + (threadIdx.x >> 5) * 32 * 13);
""")
def warp_space() -> wp.uint64:
    """Shared memory for the 32 rows of a warp."""
    ...


@wp.func_native("""
    const int lane = threadIdx.x & 31;
    float4* space = reinterpret_cast<float4*>(address);
    const float4* source = reinterpret_cast<const float4*>(sh.data) + 12 * static_cast<size_t>(row - lane);
    const int limit = 12 * (count - (row - lane));
    #pragma unroll
    for (int i = 0; i < 12; ++i) {
        const int e = 32 * i + lane;
        if (e < limit) space[e + e / 12] = __ldcs(source + e);
    }
    __syncwarp();
    wp::vec_t<48, float> result;
    #pragma unroll
    for (int i = 0; i < 12; ++i) {
        const float4 v = space[13 * lane + i];
        result[4 * i] = v.x;
        result[4 * i + 1] = v.y;
        result[4 * i + 2] = v.z;
        result[4 * i + 3] = v.w;
    }
    return result;
""")
def load_colour(address: wp.uint64, sh: wp.array2d[wp.vec3], row: wp.int32, count: wp.int32) -> Row:
    """Row ``row`` of ``sh``; every thread of the warp must call."""
    ...


@wp.func_native("""
    const int lane = threadIdx.x & 31;
    float4* space = reinterpret_cast<float4*>(address);
    float4* target = reinterpret_cast<float4*>(sh.data) + 12 * static_cast<size_t>(row - lane);
    const int limit = 12 * (count - (row - lane));
    __syncwarp();
    #pragma unroll
    for (int i = 0; i < 12; ++i)
        space[13 * lane + i] = make_float4(value[4 * i], value[4 * i + 1], value[4 * i + 2], value[4 * i + 3]);
    __syncwarp();
    #pragma unroll
    for (int i = 0; i < 12; ++i) {
        const int e = 32 * i + lane;
        if (e < limit) __stcs(target + e, space[e + e / 12]);
    }
""")
def store_colour(address: wp.uint64, sh: wp.array2d[wp.vec3], row: wp.int32, count: wp.int32, value: Row):
    """``sh[row] = value``; every thread of the warp must call."""
    ...


@wp.func
def turned_colour(c: Row, q: wp.vec4) -> Row:
    """The 16 coefficients after the rotation ``q``; band 0 stays."""
    turn = wp.quat_to_matrix(wp.quat(q[1], q[2], q[3], q[0]))
    back = wp.transpose(turn)
    result = Row()
    for j in range(3):
        result[j] = c[j]
    first = wp.mat33()
    for j in range(3):
        first[j] = wp.vec3(c[3 + 3 * j], c[4 + 3 * j], c[5 + 3 * j])
    first = turned_band_1(first, turn)
    for j in range(3):
        for k in range(3):
            result[3 + 3 * j + k] = first[j, k]
    second = Mat53()
    for j in range(5):
        second[j] = wp.vec3(c[12 + 3 * j], c[13 + 3 * j], c[14 + 3 * j])
    second = turned_band_2(second, back)
    for j in range(5):
        for k in range(3):
            result[12 + 3 * j + k] = second[j, k]
    third = Mat73()
    for j in range(7):
        third[j] = wp.vec3(c[27 + 3 * j], c[28 + 3 * j], c[29 + 3 * j])
    third = turned_band_3(third, back)
    for j in range(7):
        for k in range(3):
            result[27 + 3 * j + k] = third[j, k]
    return result


@wp.kernel
def deform_with_colour_kernel(
    count: wp.int32,
    # In:
    means: wp.array[wp.vec3],
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    max_stretch: wp.float32,
    carried: wp.array[wp.vec4],
    mean_tets: wp.array[wp.int32],
    end_tets: wp.array2d[wp.int32],
    shares: wp.array2d[wp.float32],
    arms: wp.array2d[wp.float32],
    sh: wp.array2d[wp.vec3],
    # Out:
    means_out: wp.array[wp.vec3],
    rotations_out: wp.array[wp.vec4],
    log_scales_out: wp.array[wp.vec3],
    turns_out: wp.array[wp.vec4],
    sh_out: wp.array2d[wp.vec3],
):
    """``deform_kernel`` and ``rotate_sh_kernel`` in one; launched over whole blocks."""
    row = wp.tid()
    space = warp_space()
    mine = wp.min(row, count - 1)
    result = carried_gaussian(
        mine,
        means[mine],
        load_row(rotations, mine),
        log_scales[mine],
        max_stretch,
        carried,
        mean_tets,
        end_tets,
        shares,
        arms,
    )
    if row < count:
        means_out[row] = result.mean
        store_row(rotations_out, row, result.rotation)
        log_scales_out[row] = result.log_scales
        store_row(turns_out, row, result.turn)
    colour = turned_colour(load_colour(space, sh, row, count), result.turn)
    store_colour(space, sh_out, row, count, colour)


def deform_with_colour(count: int, inputs: list, outputs: list, device: wp.Device) -> None:
    """Launch ``deform_with_colour_kernel`` over ``count`` Gaussians."""
    dim = BLOCK * ((count + BLOCK - 1) // BLOCK)
    wp.launch(
        deform_with_colour_kernel, dim=dim, inputs=[count, *inputs], outputs=outputs, device=device, block_dim=BLOCK
    )
