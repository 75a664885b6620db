"""One file per stage: its ``Config`` and ``run()``, which loads, computes and saves."""
