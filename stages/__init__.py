"""A package per stage: its ``Config``, ``run()``, which loads, computes and saves, and what it declares, ``STAGE``;
``io`` and ``hardware`` for all."""
