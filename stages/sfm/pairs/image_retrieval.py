"""How much two photos look alike as a whole, by a vocabulary of their own features: nothing is learned elsewhere.

VLAD (Jégou et al. 2010, "Aggregating local descriptors into a compact image representation"): the features of a photo
are assigned to the nearest of a few visual words, and what they differ from it is summed up per word. Each sum is
scaled to length 1, so that a pattern that repeats counts once (Arandjelović and Zisserman 2013, "All about VLAD").
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int, UInt8

WORDS = 128  # of a photo's VLAD vector
CELLS = 32  # of the inverted file that features are matched by: fewer and larger products than with more of them
ROUNDS = 10
SAMPLE = 50_000  # features that the words are made from

Descriptors = UInt8[np.ndarray, "features 128"]
Words = Float[np.ndarray, "words 128"]


def vocabulary(descriptors: Callable[[int], Descriptors], count: int, seed: int, words: int = WORDS) -> Words:
    """Visual words of these photos' own features, whole numbers; a function of the descriptors and the seed.

    ``descriptors`` gives those of one photo; they are asked for one photo at a time, so memory holds few.
    """
    random = np.random.default_rng(seed)
    sample = np.concatenate([_sampled(descriptors(photo), SAMPLE // count + 1, random) for photo in range(count)])
    return np.rint(visual_words(sample.astype(np.float32), random, words))


def photo_similarity(
    descriptors: Callable[[int], Descriptors], count: int, words: Words
) -> Float[np.ndarray, "photos photos"]:
    """Cosines between the photos' VLAD vectors (float32)."""
    vectors = np.stack([vlad(descriptors(photo).astype(np.float32), words) for photo in range(count)])
    return vectors @ vectors.T


def _sampled(descriptors: Descriptors, most: int, random: np.random.Generator) -> Descriptors:
    if len(descriptors) <= most:
        return descriptors
    return descriptors[np.sort(random.choice(len(descriptors), most, replace=False))]


def visual_words(features: Float[np.ndarray, "features 128"], random: np.random.Generator, count: int = WORDS) -> Words:
    """Centres of the features by k-means (Lloyd); fewer than ``count`` where there are fewer features."""
    words = features[random.permutation(len(features))[:count]]
    for _ in range(ROUNDS if len(words) else 0):
        sums, counts = _summed(features, _nearest_word(features, words), len(words))
        used = counts > 0  # a word that lost its features stays where it is
        words = words.copy()
        words[used] = sums[used] / counts[used, None]
    return words


def vlad(features: Float[np.ndarray, "features 128"], words: Words) -> Float[np.ndarray, "length"]:
    """The photo's vector, of length 1; zero where it has no features."""
    sums, counts = _summed(features, _nearest_word(features, words), len(words))
    residuals = _unit(sums - counts[:, None] * words)
    return _unit(residuals.reshape(1, -1))[0]


def _nearest_word(features: Float[np.ndarray, "features 128"], words: Words) -> Int[np.ndarray, "features"]:
    if not len(words):
        return np.zeros(len(features), int)
    return (features @ words.T - 0.5 * (words**2).sum(axis=1)).argmax(axis=1)


def _summed(
    features: Float[np.ndarray, "features 128"], word: Int[np.ndarray, "features"], count: int
) -> tuple[Float[np.ndarray, "words 128"], Float[np.ndarray, "words"]]:
    """The sum of each word's features, and how many they are."""
    belongs = np.zeros((count, len(features)), np.float32)
    belongs[word, np.arange(len(features))] = 1
    return belongs @ features, belongs.sum(axis=1)


def _unit(rows: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    """Rows scaled to length 1; those of length 0 as they are."""
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.divide(rows, lengths, out=np.zeros_like(rows), where=lengths > 0)
