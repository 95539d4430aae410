"""Every Warp kernel and device function, in the packages of their host code; they import only warp, ``precision`` and
each other.

Kernels read and write Warp arrays; one thread or block handles one element, point, Gaussian, pixel or QP.
"""
