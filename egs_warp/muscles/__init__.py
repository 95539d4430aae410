"""Muscle fibres inside a cage (section 3.2, Eq. 7).

Input: a cage and its up direction, or a user's file. Output: muscles with their attachments, strengths and forces. The
kernel is in ``egs_warp.kernels.muscles``.
"""
