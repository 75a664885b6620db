"""COLMAP's database: what fills it and what makes others of it. Call it in a worker process.

``images``: photos and their cameras are entered. ``extraction``: their features are extracted. ``features``: features
are read, kept in memory and compared as a whole (image similarity). ``matching``: pairs of photos are matched and
verified. ``files``: the database as a file that others read along and that is copied whole. ``copies``: copies with
fewer matches or other cameras.
"""
