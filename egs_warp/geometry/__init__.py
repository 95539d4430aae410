"""What every room speaks of: Gaussian clouds, cameras, planes, tetrahedra, frames (the paper's section 3.1).

In: arrays. Out: frozen records of them, shapes and units under each field. Nothing here reads a file or launches a
kernel.
"""
