"""Inpainting of the floor where the object stood (section 3.7).

Input: a background, the hole in its plane and an inpainter of pictures. Output: the background with new flat Gaussians
in the hole.
"""
