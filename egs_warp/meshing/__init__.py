"""Tetrahedral cages around a capture (section 3.2).

Input: a Gaussian cloud and its ground plane. Output: a ``TetMesh`` that encloses its visible part above the plane. The
kernels are in ``egs_warp/kernels/meshing``.
"""
