"""The plane under an object, and the Gaussians that belong to the object (sections 3.5, 3.6, Eq. 1, 18 to 21).

Input: a scene and masks, a point or a box. Output: a plane, an object cleared of the plane, and a background. The
kernels are in ``egs_warp/kernels/segmentation``.
"""
