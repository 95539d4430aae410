"""Kernels that call device functions one by one."""

import warp as wp

from egs_warp.kernels.deformation.decomposition import column, matched_order, rotation_part, signed_as


@wp.kernel
def rotation_parts_kernel(maps: wp.array[wp.mat33], rotations_out: wp.array[wp.mat33]):
    m = maps[wp.tid()]
    rotations_out[wp.tid()] = rotation_part(column(m, 0), column(m, 1), column(m, 2))


@wp.kernel
def orders_kernel(frames: wp.array[wp.mat33], carried: wp.array[wp.mat33], out: wp.array[wp.vec3i]):
    out[wp.tid()] = matched_order(frames[wp.tid()], carried[wp.tid()])


@wp.kernel
def signed_kernel(
    frames: wp.array[wp.mat33], orders: wp.array[wp.vec3i], carried: wp.array[wp.mat33], out: wp.array[wp.mat33]
):
    i = wp.tid()
    out[i] = signed_as(frames[i], orders[i], carried[i])
