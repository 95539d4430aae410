"""The plane under an object, and which Gaussians are the object (sections 3.5, 3.6, Eq. 1, 18 to 21).

In: a scene and masks, a point or a box. Out: a plane, an object clear of it, and a background.
"""
