"""The soft body: elements, sparse factors and the equation of one implicit step (section 3.2, Eq. 4 to 6).

In: a cage, its material, what pulls and pushes. Out: positions and velocities a step later.
"""
