"""ASCII files for photos of any name."""

import os
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from stages.io.ascii_names import ascii_files


def test_safe_names_are_kept_others_stay_readable() -> None:
    names = [("IMG_1.JPG", ".jpg"), ("sub/b-2.png", ".png"), ("Café au lait.jpg", ".jpg"), ("b.heic", ".png")]
    files = ascii_files(names)
    assert files[:2] == ["IMG_1.JPG", "sub/b-2.png"]
    assert files[2].startswith("Cafe_au_lait-") and files[2].endswith(".jpg")
    assert files[3] == "b.png"


def test_colliding_names_are_told_apart_and_the_unchanged_one_wins() -> None:
    files = ascii_files([("a.heic", ".png"), ("A.png", ".png"), ("a.png", ".png"), ("a.jpg", ".jpg")])
    assert files[1] == "A.png"
    assert len({os.path.splitext(file)[0].lower() for file in files}) == 4


@given(
    st.lists(
        st.tuples(
            st.lists(st.text(st.characters(exclude_characters="/\0", codec="utf-8"), min_size=1), min_size=1).map(
                "/".join
            ),
            st.sampled_from([".jpg", ".png"]),
        ),
        max_size=12,
        unique=True,
    )
)
def test_any_names_become_safe_and_distinct(names: list[tuple[str, str]]) -> None:
    files = ascii_files(names)
    assert files == ascii_files(names)
    assert len({os.path.splitext(file)[0].lower() for file in files}) == len(names)
    folders = {str(parent).lower() for file in files for parent in Path(file).parents}
    for file in files:
        assert file.isascii() and len(file) < 200
        assert set(file) <= set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789-_./")
        assert all(part and not part.startswith(("-", ".")) for part in file.split("/"))
        assert file.lower() not in folders
