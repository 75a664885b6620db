"""Radiance fields as mathematics on tensors: no disk, no photos, no COLMAP.

Conventions (docs/CONVENTIONS.md has the reasons):

* Camera axes are OpenCV's: x right, y down, z forward. Pixel centres lie at +0.5.
* Transforms are named by frames: ``scene_from_camera`` maps camera coordinates to scene coordinates.
* Frames: **sfm** (as structure from motion left it) and **scene** (a similarity of it, the region of
  interest inside [-0.9, 0.9]^3, +z up where an up is known). This package lives in the scene frame.
* A ray is (origin, unit direction, near, far); ``t`` is metric distance along the unit direction.
* ``t`` are interval end points, shape (..., N+1); ``weights`` are per interval, shape (..., N).
* Colour is float in [0, 1], sRGB-encoded, channels last.
* Randomness is a function of (seed, step, chunk), see ``nerf.runtime.randomness``, and which pixels are drawn one of
  (seed, how many were drawn before), see ``nerf.training.pixel_sampler``; never of call order or threads.
* How far each formula is from the truth in float32, and what it does at its limits: docs/NUMERICS.md, measured from
  the cases in ``pipeline.doctor.numerics``. A new formula gets a case there.
* Shapes are jaxtyping annotations, checked by beartype in the tests. For that reason no module here may use
  ``from __future__ import annotations``.
"""

REGION_HALF_SIZE = 0.9  # half the side of the region of interest, [-0.9, 0.9]^3 of the scene frame
MIN_SATURATED = (
    252  # of 255: from here on a photo's value may have been cut off, and tells no more than that it was bright
)
