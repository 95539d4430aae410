"""The soft body: elements, sparse factors and the equation of one implicit step (section 3.2, Eq. 4 to 6).

In: a cage, its material, what pulls and pushes. Out: positions and velocities a step later.
"""

import os

# rslab's own allocator (mimalloc) gives memory back to the system at once: the pages of every solve came anew, which
# took a sixth of a step. Told when it is loaded, so before anything of this room.
os.environ.setdefault("MIMALLOC_PURGE_DELAY", "-1")
