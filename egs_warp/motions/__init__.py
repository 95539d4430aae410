"""What a body is asked to do: jump, hop, twist, walk, key frames, scripts (section 4).

In: a body's state at each step. Out: the objectives of the next one.
"""
