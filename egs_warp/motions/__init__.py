"""Motions of a body: jump, hop, twist, walk, crawl, roll, dance, get up, gestures, key frames and scripts (section 4).

A motion is a state machine that computes the objectives of the next step from the measured state of the body.
"""
