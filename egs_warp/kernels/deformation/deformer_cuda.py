"""Eq. (14), (15) and the rotation of SH of degree 3 on CUDA: one thread per Gaussian, one pass over memory.

A Gaussian's row of coefficients is 192 bytes long. A warp copies its 32 rows through shared memory in contiguous
16-byte units, because in direct reads of the rows every load would touch 32 cache lines. Only these copies are written
in CUDA C++; the mathematics is the same as on the CPU.
"""

import warp as wp

from egs_warp.kernels.deformation.cage_maps import ArmPlan, CageMaps, load_row, store_row
from egs_warp.kernels.deformation.deformer import deform_gaussian
from egs_warp.kernels.deformation.spherical_harmonics import Colour, rotate_sh

wp.set_module_options({"enable_backward": False, "fast_math": True})

BLOCK = 128


@wp.func_native("""
    // 13 float4 a row: an odd stride avoids bank conflicts in both access patterns.
    __shared__ float4 space[128 * 13];
    return reinterpret_cast<uint64_t>(space + (threadIdx.x >> 5) * 32 * 13);
""")
def warp_space() -> wp.uint64:
    """Return the address of the shared memory for the 32 rows of this thread's warp."""
    ...


@wp.func_native("""
    const int lane = threadIdx.x & 31;
    const float4* source = reinterpret_cast<const float4*>(sh.data) + 12 * static_cast<size_t>(row - lane);
    const int limit = 12 * (count - (row - lane));
    float4* space = reinterpret_cast<float4*>(address);
#if __CUDA_ARCH__ >= 800
    const unsigned first = static_cast<unsigned>(__cvta_generic_to_shared(space));
#endif
    // 96 pieces are 8 rows: piece e is at e + e / 12, which is 104 past piece e - 96.
    const int at[3] = {lane + lane / 12, lane + 32 + (lane + 32) / 12, lane + 64 + (lane + 64) / 12};
    #pragma unroll
    for (int i = 0; i < 12; ++i) {
        const int to = at[i % 3] + 104 * (i / 3);
        if (32 * i + lane < limit) {
#if __CUDA_ARCH__ >= 800
            asm volatile("cp.async.cg.shared.global [%0], [%1], 16;"
                         :: "r"(first + 16 * to), "l"(source + 32 * i + lane) : "memory");
#else
            space[to] = __ldcs(source + 32 * i + lane);
#endif
        }
    }
""")
def fetch_colour(address: wp.uint64, sh: wp.array2d[wp.vec3], row: wp.int32, count: wp.int32):
    """Start copying the warp's rows of colours ``sh`` (count, 16) to shared memory at ``address``; asynchronously on
    Ampere and newer GPUs. ``row`` is the row of this thread.
    """
    ...


@wp.func_native("""
    const int lane = threadIdx.x & 31;
    float4* space = reinterpret_cast<float4*>(address);
#if __CUDA_ARCH__ >= 800
    asm volatile("cp.async.wait_all;" ::: "memory");
#endif
    __syncwarp();
    wp::mat_t<16, 3, float> result;
    float* values = &result.data[0][0];
    #pragma unroll
    for (int i = 0; i < 12; ++i) {
        const float4 v = space[13 * lane + i];
        values[4 * i] = v.x;
        values[4 * i + 1] = v.y;
        values[4 * i + 2] = v.z;
        values[4 * i + 3] = v.w;
    }
    return result;
""")
def load_colour(address: wp.uint64) -> Colour:
    """Return this thread's row of the colours that ``fetch_colour`` has copied. Every thread of the warp must call this
    function.
    """
    ...


@wp.func_native("""
    const int lane = threadIdx.x & 31;
    float4* space = reinterpret_cast<float4*>(address);
    float4* target = reinterpret_cast<float4*>(sh.data) + 12 * static_cast<size_t>(row - lane);
    const int limit = 12 * (count - (row - lane));
    const float* values = &value.data[0][0];
    __syncwarp();
    #pragma unroll
    for (int i = 0; i < 12; ++i)
        space[13 * lane + i] = make_float4(values[4 * i], values[4 * i + 1], values[4 * i + 2], values[4 * i + 3]);
    __syncwarp();
    const int at[3] = {lane + lane / 12, lane + 32 + (lane + 32) / 12, lane + 64 + (lane + 64) / 12};
    #pragma unroll
    for (int i = 0; i < 12; ++i)
        if (32 * i + lane < limit) __stcs(target + 32 * i + lane, space[at[i % 3] + 104 * (i / 3)]);
""")
def store_colour(address: wp.uint64, sh: wp.array2d[wp.vec3], row: wp.int32, count: wp.int32, value: Colour):
    """Set ``sh[row]`` to ``value`` through shared memory at ``address``. Every thread of the warp must call this
    function.
    """
    ...


@wp.kernel(grid_stride=False)
def deform_with_colour_kernel(
    count: wp.int32,
    # In:
    means: wp.array[wp.vec3],
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    max_stretch: wp.float32,
    cage: CageMaps,
    plan: ArmPlan,
    sh: wp.array2d[wp.vec3],
    # Out:
    means_out: wp.array[wp.vec3],
    rotations_out: wp.array[wp.vec4],
    log_scales_out: wp.array[wp.vec3],
    polar_rotations_out: wp.array[wp.vec4],
    sh_out: wp.array2d[wp.vec3],
):
    """Deform each Gaussian and rotate its colour in one pass, as ``deform_kernel`` and ``rotate_sh_kernel`` do;
    launched over whole blocks.

    Args:
        count: number n of Gaussians.
        means, rotations, log_scales, max_stretch, cage, plan: as in ``deform_kernel``.
        sh, sh_out: (n, 16) coefficients of the colours before and after the rotation.
        means_out, rotations_out, log_scales_out, polar_rotations_out: as in ``deform_kernel``.
    """
    row = wp.tid()
    space = warp_space()
    fetch_colour(space, sh, row, count)
    clamped_row = wp.min(row, count - 1)
    result = deform_gaussian(
        clamped_row,
        means[clamped_row],
        load_row(rotations, clamped_row),
        log_scales[clamped_row],
        max_stretch,
        cage,
        plan,
    )
    if row < count:
        means_out[row] = result.mean
        store_row(rotations_out, row, result.rotation)
        log_scales_out[row] = result.log_scales
        store_row(polar_rotations_out, row, result.polar_rotation)
    colour = rotate_sh(load_colour(space), result.polar_rotation, 3)
    store_colour(space, sh_out, row, count, colour)


def deform_with_colour(count: int, inputs: list, outputs: list, device: wp.Device) -> None:
    """Launch ``deform_with_colour_kernel`` over ``count`` Gaussians."""
    dim = BLOCK * ((count + BLOCK - 1) // BLOCK)
    wp.launch(
        deform_with_colour_kernel, dim=dim, inputs=[count, *inputs], outputs=outputs, device=device, block_dim=BLOCK
    )
