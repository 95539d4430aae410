"""The soft body: elements, sparse factors and the equation of one implicit step (section 3.2, Eq. 4 to 6).

Input: a cage, its material and the forces on it. Output: nodal positions and velocities one step later. The
kernels are in ``egs_warp.kernels.fem``.
"""
