"""Photos from a video: its frames chosen by motion and sharpness, and turned into sRGB."""
