"""Which activations to send: the program of a step, its contact states and its solvers (section 3.3, Eq. 9, 12, 13).

In: a body, objectives on its velocities, contact points. Out: activations, the step they make, and its audit.
"""
