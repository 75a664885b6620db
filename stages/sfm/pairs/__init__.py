"""Which pairs of photos to match, and which of their features look alike."""
