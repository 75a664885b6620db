"""Imported poses: read, turned upright, written as a model, checked."""
