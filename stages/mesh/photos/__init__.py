"""The photos as seen from a surface: which of them show it where, in which colours, and where they agree that it is."""
