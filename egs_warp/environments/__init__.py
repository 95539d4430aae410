"""Environments for reinforcement learning and optimisation over many worlds (beyond the paper; extra ``gymnasium``).

Input: a creature and the actions of each world. Output: observations and rewards of each world, and ends of episodes.
"""
