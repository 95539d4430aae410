"""Choice of the muscle activations of each step: QP, contact modes and solvers (section 3.3, Eq. 9, 12, 13).

Input: a body, objectives on its velocities, and contact points. Output: activations, the simulated step, and its audit.
Entry points: ``LocomotionStepper`` makes one step, ``rollout_steps`` a whole run.
"""
