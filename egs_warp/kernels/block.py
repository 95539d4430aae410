"""Barriers and reductions over the threads of a block on a GPU; on a CPU a block is one thread.

Blocks must consist of whole warps, and all threads of a block must call each function.
"""

import warp as wp

from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
""")
def sync_block():
    """Synchronise the threads of the block; writes before the barrier are visible after it."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ double parts[32];
    for (int other = 16; other > 0; other >>= 1)
        value = fmax(value, __shfl_xor_sync(0xffffffffu, value, other));
    __syncthreads();
    if ((threadIdx.x & 31) == 0) parts[threadIdx.x >> 5] = value;
    __syncthreads();
    value = parts[0];
    for (int i = 1; i < blockDim.x >> 5; ++i) value = fmax(value, parts[i]);
#endif
    return value;
""")
def block_max(value: real) -> real:
    """Return the maximum of ``value`` over the block; synchronises the block."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ double parts[32];
    for (int other = 16; other > 0; other >>= 1)
        value += __shfl_xor_sync(0xffffffffu, value, other);
    __syncthreads();
    if ((threadIdx.x & 31) == 0) parts[threadIdx.x >> 5] = value;
    __syncthreads();
    value = parts[0];
    for (int i = 1; i < blockDim.x >> 5; ++i) value += parts[i];
#endif
    return value;
""")
def sum_of_block(value: real) -> real:
    """Return the sum of ``value`` over the block; synchronises the block."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return 32;
#else
    return 1;
#endif
""")
def warp_size() -> int:
    """Return the number of threads of a warp: 32 on a GPU, 1 on a CPU (``launching.lanes_on``)."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int other = 16; other > 0; other >>= 1)
        value += __shfl_xor_sync(0xffffffffu, value, other);
#endif
    return value;
""")
def warp_sum(value: real) -> real:
    """Return the sum of ``value`` over a warp, all of whose threads must call this function."""
    ...
