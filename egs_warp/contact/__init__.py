"""Contact with the ground and solids: gaps, contact points, Coulomb's law and the coupled step (section 3.3, Eq. 8, 9).

The input is a moving cage with embedded Gaussians, and terrain. The output is contact points and the forces on them
that satisfy Coulomb's law. A step runs through ``detection`` (gaps), ``selection`` (contact points) and
``coupled_step`` (Newton's method), which uses ``newton`` and ``coulomb``. The ``host_`` and ``device_`` modules
implement the same for one body on a CPU and on a GPU, the ``batch_`` modules for many worlds.
"""
