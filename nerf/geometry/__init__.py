"""Rays, cameras and the scene; contraction of space, near and far, the region of interest, alignment, camera paths."""
