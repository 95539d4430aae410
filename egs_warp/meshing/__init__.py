"""Tetrahedral cages around a capture (section 3.2).

Input: a Gaussian cloud and the plane it stands on. Output: a ``TetMesh`` that encloses its visible part. The kernels
are in ``egs_warp/kernels/meshing``.
"""
