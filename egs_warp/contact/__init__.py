"""Contact with the ground and solids: gaps, contact points, Coulomb's law and the coupled step (section 3.3, Eq. 8, 9).

Input: a moving cage with embedded Gaussians, and terrain. Output: contact points and forces that satisfy Coulomb's law.
One body on a CPU, one body on a GPU (``device_``) and many worlds (``batch_``) have separate modules.
"""
