"""Main light of a capture, estimated from shadow and shading. This extends the rendering of section 3.1.

Input: an object, its ground, the rest of the capture. Output: a ``MainLight``, the creature relit by it, and the ground
without the captured shadow. The kernels are in ``egs_warp/kernels/lighting``.
"""
