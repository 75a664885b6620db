"""COLMAP's database: features, matches, copies of it."""
