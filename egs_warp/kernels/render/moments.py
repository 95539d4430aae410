"""Sums of the moments of Gaussians with many (Gaussian, tile) pairs, on a GPU.

``composite_backward_block_kernel`` writes the moments (slots, 3) of each pair, and ``tiles`` describes the slots. One
thread that adds thousands of them takes longer than all others together. Host code: ``egs_warp/render/backward.py``.
"""

import warp as wp

from egs_warp.kernels.render.tiles import first_slot_of
from egs_warp.kernels.render.vector_math import on_cpu

wp.set_module_options({"enable_backward": False, "fast_math": True})

LANES = wp.constant(32)
"""Number of threads that add the moments of one Gaussian on a GPU."""
FEW_SLOTS = wp.constant(16)
"""Maximum number of slots that one thread adds on a GPU, because it waits for the memory at each of them."""


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    return end_slot - first_slot > {int(FEW_SLOTS)} ? first_slot + 1 : end_slot;
#else
    return end_slot;
#endif
""")
def end_of_sum(first_slot: wp.int32, end_slot: wp.int32) -> wp.int32:
    """Return the end of the slots to add: on a GPU, ``add_moments_kernel`` has already added those of Gaussians with
    many slots.
    """
    ...


@wp.func_native(
    on_cpu(
        "",
        cuda="""
    constexpr unsigned ALL = 0xffffffffu;
    const int lane = threadIdx.x & 31;
    unsigned todo = __ballot_sync(ALL, end_slot - first_slot > few_slots);
    while (todo) {
        const int owner = __ffs(todo) - 1;
        todo &= todo - 1;
        const int first = __shfl_sync(ALL, first_slot, owner), count = __shfl_sync(ALL, end_slot, owner) - first;
        float4* const rows = (float4*)moments.data + 3 * (size_t)first;
        float sums[12] = {};
        for (int slot = lane; slot < count; slot += 32) {
            #pragma unroll
            for (int k = 0; k < 3; ++k) {
                const float4 row = rows[3 * (size_t)slot + k];
                sums[4 * k] += row.x;
                sums[4 * k + 1] += row.y;
                sums[4 * k + 2] += row.z;
                sums[4 * k + 3] += row.w;
            }
        }
        #pragma unroll
        for (int distance = 16; distance > 0; distance /= 2)
            #pragma unroll
            for (int i = 0; i < 12; ++i) sums[i] += __shfl_xor_sync(ALL, sums[i], distance);
        // The shuffles follow the loads of all lanes.
        if (lane == 0)
            #pragma unroll
            for (int k = 0; k < 3; ++k)
                rows[k] = make_float4(sums[4 * k], sums[4 * k + 1], sums[4 * k + 2], sums[4 * k + 3]);
    }
""",
    )
)
def add_moments(first_slot: wp.int32, end_slot: wp.int32, few_slots: wp.int32, moments: wp.array2d[wp.vec4]):
    """Add the moments of the Gaussians of the 32 threads of a warp that have more than ``few_slots`` slots (CUDA only).
    The warp adds those of one Gaussian after the other, and writes the sum to the Gaussian's first slot.
    """
    ...


@wp.kernel(grid_stride=False)
def add_moments_kernel(
    # In:
    warps: wp.int32,
    slot_end: wp.array[wp.int64],
    # Out:
    moments_out: wp.array2d[wp.vec4],
):
    """Add the moments of each Gaussian with more than ``FEW_SLOTS`` slots, by ``LANES`` threads for each of the
    ``warps`` (CUDA only). Nothing happens if the slots exceed the length of ``moments_out``.
    """
    slots = slot_end[slot_end.shape[0] - 1]
    if slots >= wp.int64(0) and slots <= wp.int64(moments_out.shape[0]):
        # Neighbours are in different warps, because large Gaussians are often neighbours.
        g = (wp.tid() % LANES) * warps + wp.tid() / LANES
        first_slot = wp.int32(0)
        end_slot = wp.int32(0)
        if g < slot_end.shape[0]:
            first_slot = first_slot_of(slot_end, g)
            end_slot = wp.int32(slot_end[g])
        add_moments(first_slot, end_slot, FEW_SLOTS, moments_out)
