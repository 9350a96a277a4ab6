"""Pixels of two views that show the same point of an object, sub-pixel in the second view, with every doubt a
rejection.

Depth comes from the fused surface, which has a fraction of one image's noise, corrected where the image's own
measurements say clearly that it is wrong (fusion rounds edges). Without a surface, depth is the measured one.
"""
