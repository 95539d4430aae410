"""The floor where the object stood (section 3.7).

In: a background, the hole in its plane, an inpainter of pictures. Out: the background with new flat Gaussians in the
hole.
"""
