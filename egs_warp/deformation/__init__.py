"""Deformation of Gaussians by their cage: embedding, deformation, splitting and baselines (sections 3.1, 3.4).

Input: a cloud, its rest cage and the displaced nodes. Output: the deformed cloud (Eq. 2, 3, 14 to 17).
"""
