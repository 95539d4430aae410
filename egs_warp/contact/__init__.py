"""The ground: gaps, penalties, Coulomb's law and the corrector of a step (section 3.3, Eq. 8 to 11).

In: a moving cage with embedded Gaussians, and terrain. Out: contact points and the forces that obey Coulomb at them.
"""
