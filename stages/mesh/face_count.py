"""How many faces of its surface a mesh keeps where the user does not say."""

# docs/experiments/mesh.md: leaves take many, walls few.
MIN_FACES, MAX_FACES, FACES_KEPT = 100_000, 300_000, 0.25


def default_faces(found: int, textured: bool) -> int:
    """How many of the faces ``found`` to keep, at least how many with 0. A smooth surface with a texture looks the same
    with fewer; without one, each face shows a colour."""
    return min(MAX_FACES, max(MIN_FACES, round(FACES_KEPT * found))) if textured else MAX_FACES
