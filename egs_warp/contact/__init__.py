"""The ground: gaps, contact points, Coulomb's law and the step that obeys it (section 3.3, Eq. 8, 9).

In: a moving cage with embedded Gaussians, and terrain. Out: contact points and the forces that obey Coulomb at them.
"""
