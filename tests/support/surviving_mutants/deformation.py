"""Surviving mutants of ``deformation`` and its kernels."""

from __future__ import annotations

from tests.support.surviving_mutants.survivor import Survivor

DEFORMATION = [
    Survivor(
        "kernels/deformation/embedding.py",
        "if vb <= real(0.0) and d2 >= real(0.0) and d6 <= real(0.0):",
        "if vb < real(0.0) and d2 >= real(0.0) and d6 <= real(0.0):",
        "on the boundary of two cases both give the same point of the triangle",
    ),
    Survivor(
        "kernels/deformation/embedding.py",
        "if weights[3] < real(0.0):",
        "if weights[3] <= real(0.0):",
        "one more face is tested, which is never closer than the nearest",
    ),
    Survivor(
        "deformation/embedding.py",
        "points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)",
        "points = np.ascontiguousarray(points, dtype=np.float64).reshape(- 2, 3)",
        "NumPy infers the size of a dimension given by any negative number",
    ),
    Survivor(
        "kernels/deformation/decomposition.py",
        "MAX_SWEEPS = wp.constant(8)",
        "MAX_SWEEPS = wp.constant( 9)",
        "eight sweeps have converged; the ninth changes nothing",
    ),
    Survivor(
        "kernels/deformation/embedding.py",
        "if attempt == MAX_ARM_LENGTHS or real(arm) * ARM_SHORTENING < min_arm:",
        "if attempt >= MAX_ARM_LENGTHS or real(arm) * ARM_SHORTENING < min_arm:",
        "the counter reaches the bound in steps of one",
    ),
    Survivor(
        "deformation/splitting.py",
        "MIN_OPACITY = 2.0 / 255.0",
        "MIN_OPACITY = 2.0 / 254.0",
        "the constant changes by 0.4 %",
    ),
    Survivor(
        "kernels/deformation/decomposition.py",
        "longer = unit_or(wp.where(first, a, b), wp.where(first, wp.vec3(1.0, 0.0, 0.0), wp.vec3(0.0, 1.0, 0.0)))",
        "longer = unit_or(wp.where(first, a, b), wp.where(first, wp.vec3(1.0, 0.0, 0.0), wp.vec3(0.0, 2.0, 0.0)))",
        "the longer of two is nonzero, unless both are zero, and then the first counts as longer",
    ),
    Survivor(
        "kernels/deformation/cage_maps.py",
        "RIGID = wp.constant(wp.float32(3.0))",
        "RIGID = wp.constant(wp.float32( 4.0))",
        "a marker value that no share of a tetrahedron equals",
    ),
    Survivor(
        "kernels/deformation/decomposition.py",
        "longer = unit_or(wp.where(first, a, b), wp.where(first, wp.vec3(1.0, 0.0, 0.0), wp.vec3(0.0, 1.0, 0.0)))",
        "longer = unit_or(wp.where(first, a, b), wp.where(first, wp.vec3(1.0, 0.0, 1.0), wp.vec3(0.0, 1.0, 0.0)))",
        "the longer of two is nonzero, unless both are zero, and then the first counts as longer",
    ),
    Survivor(
        "kernels/deformation/decomposition.py",
        "elif yy >= zz:",
        "elif yy > zz:",
        "if two are equal, either gives the rotation",
    ),
    Survivor(
        "kernels/deformation/decomposition.py",
        "size = wp.dot(a, a) + wp.dot(b, b) + wp.dot(c, c)",
        "size = wp.dot(a, a) + wp.dot(b, b) % wp.dot(c, c)",
        "selects one of two methods near flat maps: both are equally close to SciPy's in 600,000 cases",
    ),
    Survivor(
        "kernels/deformation/embedding.py",
        "if va <= real(0.0) and d4 - d3 >= real(0.0) and d5 - d6 >= real(0.0):",
        "if va <= real(0.0) and d4 - d3 >= real( -1.0) and d5 - d6 >= real(0.0):",
        "a point before b along b c is closest to b or to a b, which are tested before: there it is never below 0",
    ),
    Survivor(
        "kernels/deformation/embedding.py",
        "if weights[2] < real(0.0):",
        "if weights[2] <= real(0.0):",
        "one more face is tested, which is never closer than the nearest",
    ),
    Survivor(
        "kernels/deformation/spherical_harmonics.py",
        "Mat53 = wp.types.matrix(shape=(5, 3), dtype=wp.float32)",
        "Mat53 = wp.types.matrix(shape=( 6, 3), dtype=wp.float32)",
        "a sixth row that nothing reads",
    ),
]
