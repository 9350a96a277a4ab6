"""Matches: pixels of two views that show the same point of an object, sub-pixel in the second view. A doubtful match
is rejected.

Depth comes from the fused surface, which has a fraction of one image's noise, corrected where the image's own
measurements contradict it significantly (fusion rounds edges). Without a surface, measured depth is used.
"""
