"""Cameras, poses and points of a model adjusted to its observations. Call it in a worker process.

``observations``: observations and their errors as arrays. ``bundle_adjustment``: the adjustment itself.
``final_bundle_adjustment``: the last step of structure-from-motion. It takes the camera model of
``camera_model_selection``, whose candidates ``intrinsics`` has, and tells the ``uncertainty`` of the poses.
``imported_models``: what is adjusted of imported poses, and the points that they get.
"""
