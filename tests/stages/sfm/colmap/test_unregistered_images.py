from pathlib import Path

import numpy as np
import pycolmap

from stages.sfm.colmap.database.matching import match_pairs
from stages.sfm.colmap.unregistered_images import links
from stages.sfm.pairs.pair_selection import exhaustive
from tests.stages.sfm.colmap.conftest import COUNT


def test_unregistered_photos_are_joined_by_their_matches(database: Path) -> None:
    match_pairs(database, exhaustive(COUNT), 0, 0.8)
    names = [f"{i}.png" for i in range(COUNT)]
    assert links(database, set(names[:-2])).join
    assert not links(database, set(names[:-1])).join
    assert not links(database, {names[-1]}).join, "five that share views with each other alone"
    assert links(database, set()).join, "none is registered: any pair may be the initial one"


def test_few_matches_with_each_of_several_photos_join_as_well(database: Path) -> None:
    match_pairs(database, exhaustive(COUNT), 0, 0.8)
    placed = {f"{i}.png" for i in range(COUNT - 1)}
    for photo, expected in ((1, False), (2, True)):
        with pycolmap.Database.open(database) as db:
            db.delete_two_view_geometry(photo, COUNT)
            few = pycolmap.TwoViewGeometry(inlier_matches=np.tile(np.arange(20, dtype=np.uint32)[:, None], 2), config=2)
            db.write_two_view_geometry(photo, COUNT, few)
        assert links(database, placed).join == expected
