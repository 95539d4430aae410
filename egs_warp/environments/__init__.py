"""Environments for reinforcement learning and optimisation over many worlds (beyond the paper; extra ``gymnasium``).

Input: a creature, actions of each world. Output: observations, rewards and ended episodes of each world.
"""
