"""EXIF orientation (EXIF 2.32, tag 0x0112; read in exif.py) undone: pixels and sizes of photos turned upright.

Cameras of photos as they are stored are turned with them: stages/sfm/colmap/cameras.py.
"""

from PIL import Image

from stages.io.pixels import pillow

QUARTER_TURNS = {1: 0, 6: 1, 3: 2, 8: 3}  # clockwise, that make a stored photo upright; the other orientations mirror
FIRST_SIDEWAYS = 5  # from here on width and height change places


def upright(image: Image.Image, orientation: int) -> Image.Image:
    """Undo an EXIF orientation (EXIF 2.32, tag 0x0112)."""
    turns = pillow().Transpose
    turn = {
        2: turns.FLIP_LEFT_RIGHT,
        3: turns.ROTATE_180,
        4: turns.FLIP_TOP_BOTTOM,
        5: turns.TRANSPOSE,
        6: turns.ROTATE_270,
        7: turns.TRANSVERSE,
        8: turns.ROTATE_90,
    }.get(orientation)
    return image if turn is None else image.transpose(turn)


def turned_size(size: tuple[int, int], orientation: int) -> tuple[int, int]:
    """Width and height of a stored image once its orientation is undone, and the other way round."""
    return (size[1], size[0]) if orientation >= FIRST_SIDEWAYS else size
