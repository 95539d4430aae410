"""Gaussians follow their cage: embedding, deformation, splitting, and the ways of the paper's peers (sections 3.1,
3.4).

In: a cloud, its rest cage and the moved nodes. Out: the moved cloud (Eq. 2, 3, 14 to 17).
"""
