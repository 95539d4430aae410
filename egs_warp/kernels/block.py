"""What threads of a block on a GPU do together; on a CPU a block is one thread, which has nobody to wait for.

Blocks have whole warps, and all of their threads call.
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
    """Until all threads of the block are here, and see what the others have written."""
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
    """Of the threads' values; they have waited for each other."""
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
    """Of the threads' values; they have waited for each other."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return 32;
#else
    return 1;
#endif
""")
def warp_size() -> int:
    """Threads of a warp, see ``launching.lanes_on``."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int other = 16; other > 0; other >>= 1)
        value += __shfl_xor_sync(0xffffffffu, value, other);
#endif
    return value;
""")
def warp_sum(value: real) -> real:
    """Of the values of a warp's threads, all of which call."""
    ...
