"""Cameras that are known already: read, turned upright, written as a model, checked."""
