"""What the threads of a block, the ``lanes`` of one problem, share on a GPU; on a CPU each problem has one."""

import warp as wp


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
""")
def wait_for_lanes():
    """Until all lanes of a problem are here, and see what each has written."""
    ...
