"""What scoring takes beside rendering, and how long rendering may take: what is known before a run."""

SHARE = 0.1  # of the training's seconds that rendering may take where no seconds are given,
MIN_RENDERING = 5.0  # and what it may take in any case
STEREO_SHARE = 0.5  # of the same time, on top, to compare depth with stereo where there are depth maps
STARTING_SECONDS = 1.0  # imports, and timing how fast the field renders
# For each photo of the set: all are read for the mean image, every eighth is compared with its nearest neighbour.
SECONDS_PER_PHOTO = 0.1  # of one core


def other_seconds(photos: int, cores: int) -> float:
    """Beside rendering: a set of so many photos is read and compared."""
    return STARTING_SECONDS + SECONDS_PER_PHOTO * photos / cores
