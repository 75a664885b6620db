"""Random numbers as a function of (seed, counters) alone, so that results survive resuming, chunking and threads."""

import hashlib

import torch


def generator(device: torch.device | str, seed: int, *counters: int) -> torch.Generator:
    """A generator on ``device`` that depends on nothing but ``seed`` and ``counters`` (step, chunk, ...).

    The 64-bit state seed is a SHA-256 of the numbers, so neighbouring counters give unrelated streams and no two
    argument lists share one by arithmetic. (Torch's CPU generator keeps 32 of the 64 bits: two of 100 000 steps may
    draw the same jitter, which does no harm.)
    """
    digest = hashlib.sha256(repr((seed, *counters)).encode()).digest()
    return torch.Generator(device).manual_seed(int.from_bytes(digest[:8], "big"))
