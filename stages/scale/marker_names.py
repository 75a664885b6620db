"""Printed markers as they are named in options: dictionary, number, length of the black square."""

import re
from typing import NamedTuple

from stages.scale.lengths import parse_length

# cv2.aruco's predefined dictionaries, without DICT_, and how many markers each has. Held here, so that a command line
# is checked without loading OpenCV.
DICTIONARIES = {
    **{f"{bits}X{bits}_{count}": count for bits in (4, 5, 6, 7) for count in (50, 100, 250, 1000)},
    "ARUCO_ORIGINAL": 1024,
    "ARUCO_MIP_36h12": 250,
    "APRILTAG_16h5": 30,
    "APRILTAG_25h9": 35,
    "APRILTAG_36h10": 2320,
    "APRILTAG_36h11": 587,
}


class Marker(NamedTuple):
    """A marker of ``dictionary`` (cv2.aruco's name) with the outer side of its black square in metres."""

    dictionary: str
    number: int
    side_m: float

    @property
    def name(self) -> str:
        """As it is given, without the length."""
        return f"{self.dictionary}:{self.number}"

    @property
    def printed(self) -> str:
        """The same for all names of a marker: the first fifty of 4X4_1000 are those of 4X4_50."""
        return printed_name(self.dictionary, self.number)


def printed_name(dictionary: str, number: int) -> str:
    """A marker's name in the smallest dictionary that has it."""
    family = dictionary.split("_")[0] + "_" if dictionary[0].isdigit() else dictionary
    alike = (name for name, count in DICTIONARIES.items() if name.startswith(family) and number < count)
    return f"{next(alike)}:{number}"


def parse_marker(text: str) -> Marker:
    """The marker in ``DICTIONARY:ID=LENGTH``; ``tag36h11`` and ``DICT_4X4_50`` are understood too, in any case.

    Raises ValueError for anything else.
    """
    found = re.fullmatch(r"\s*([\w]+)\s*:\s*(\d+)\s*=\s*(.+)", text)
    if not found:
        raise ValueError(f"{text!r} is not a marker: write DICTIONARY:ID=LENGTH, such as 4X4_50:7=50mm")
    asked = re.sub(r"^(DICT_)?(TAG(?=\d))?", lambda prefix: "APRILTAG_" if prefix[2] else "", found[1].upper())
    names = {name.upper(): name for name in DICTIONARIES}
    if (dictionary := names.get(asked)) is None:
        raise ValueError(f"there is no dictionary {found[1]!r}; there are: {', '.join(DICTIONARIES)}")
    if int(found[2]) >= DICTIONARIES[dictionary]:
        raise ValueError(f"{dictionary} has markers 0 to {DICTIONARIES[dictionary] - 1}, not {found[2]}")
    return Marker(dictionary, int(found[2]), parse_length(found[3]))
