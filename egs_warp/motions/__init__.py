"""Motions of a body: jump, hop, twist, walk, crawl, roll, dance, getting up, gestures, key frames and scripts
(section 4).

Input: the measured state of the body. Output: the objectives of the next step. Each motion is a state machine.
"""
