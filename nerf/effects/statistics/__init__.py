"""What the sparse model and the training photos say about each optional effect: statistics, no training.

One small module an effect, each ending in a function that gives an ``Statistic``: a number, its noise, and the size
from which on the effect is called for. ``TrackColours`` is what most of them look at. Photometry happens in linear
light, in natural logarithms; 1 EV is ln 2. Everything is numpy float64, deterministic, and asks for no disk.
"""
