"""Number types in kernels: Gaussians use float32 (Warp's ``vec3``, ``mat33``), mechanics the float64 types here."""

import warp as wp

real = wp.float64
Vec3 = wp.vec3d
Vec4 = wp.vec4d
Mat33 = wp.mat33d
