"""A cage of tetrahedra around a capture (section 3.2).

In: a Gaussian cloud and the plane it stands on. Out: a ``TetMesh`` that encloses what of it is visible.
"""
