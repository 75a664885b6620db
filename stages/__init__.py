"""A package per stage: its ``Config`` and ``run()``, which loads, computes and saves; ``io``, ``hardware`` for all."""
