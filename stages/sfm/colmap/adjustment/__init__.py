"""Cameras, poses and points adjusted to observations: with which camera model, how exactly, what comes out degenerate.

``observations``: observations and their errors as arrays. ``intrinsics``: what a camera may be, and when it is
degenerate. ``camera_model_selection``: which camera model the observations call for. ``final_bundle_adjustment``: the
last step of structure-from-motion. ``uncertainty``: how well it leaves poses known.
"""
