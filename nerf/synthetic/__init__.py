"""Synthetic scenes with exact geometry: shapes, textures, a still life."""
