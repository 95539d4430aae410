"""Float64 types for the kernels of the mechanics; kernels for Gaussians use Warp's float32 types (``vec3``,
``mat33``)."""

import warp as wp

real = wp.float64
Vec3 = wp.vec3d
Vec4 = wp.vec4d
Mat33 = wp.mat33d
