"""Environments for reinforcement learning and optimisation over many worlds; they need the extra ``gymnasium``."""
