"""The texture of a mesh: an atlas of charts, and the photos' colours in it."""
