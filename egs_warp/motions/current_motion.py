"""The running motion of a sequence, if it has a world axis."""

from __future__ import annotations

from typing import Any

from egs_warp.motions.hop import Hop
from egs_warp.motions.joined_motion import JoinedMotion
from egs_warp.motions.sequence import MotionSequence
from egs_warp.motions.turn import Turn


def joined_motion(sequence: MotionSequence) -> JoinedMotion[Any] | None:
    """Return the motion that alone determines the objectives of the next step of ``sequence``; None if the current
    motion has no world axis, or if another motion is about to start."""
    if not sequence.done:
        return None
    motion = sequence.done[-1].motion
    joined: object = motion
    if isinstance(motion, Turn):
        joined = motion.jumps[-1]
    elif isinstance(motion, Hop):
        joined = motion.jump
    if not isinstance(joined, JoinedMotion):
        return None
    may_continue = isinstance(motion, Turn) or not sequence.is_finished
    return None if motion.is_at_rest and may_continue else joined
