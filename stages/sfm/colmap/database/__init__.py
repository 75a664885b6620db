"""COLMAP's database: what fills it, and copies of it with other matches or cameras. Call it in a worker process.

``images``: photos and their cameras are entered. ``extraction``: features are extracted. ``features``: they are read,
and kept in memory; what they tell of how similar photos are. ``matching``: pairs of photos are matched and verified.
``correspondences``: verified matches as arrays. ``calibration``: focal lengths by all verified pairs together.

``files``: the database as a file that others read along and that is copied whole. ``copies``: copies with fewer matches
or other cameras. ``thinning``: the copy with the longest tracks, on which many photos are mapped.

Where functions speak of photos these are numbered from 0, as everywhere in stage sfm; an image id is 1 more.
"""
