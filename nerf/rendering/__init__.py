"""From samples along rays to pictures: sampling, volume rendering, early termination, sRGB."""
