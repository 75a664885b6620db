"""Numbers beside the points of a study's plot."""

from stages.tradeoff.plot import NUMBER, Label, side_by_side


def test_numbers_of_points_that_lie_together_stand_side_by_side() -> None:
    together = [Label(300.0, 50.0, (17,)), Label(305.0, 49.0, (19,)), Label(302.0, 50.5, (18,))]
    above, beside = Label(301.0, 50.0 + 2 * NUMBER, (5,)), Label(290.0, 50.0, (9,))
    joined = Label(305.0, 49.0, (17, 18, 19))
    assert sorted(side_by_side([*together, above, beside])) == sorted([joined, above, beside])
    assert side_by_side([]) == []


def test_what_a_longer_label_comes_to_lie_on_joins_it() -> None:
    first, second, third = (Label(x, 0.0, (number,)) for x, number in ((0.0, 1), (3.0, 2), (3.0 + 1.5 * NUMBER, 3)))
    assert side_by_side([first, third]) == [first, third]
    assert side_by_side([second, third]) == [second, third]
    assert side_by_side([first, second, third]) == [Label(third.x, 0.0, (1, 2, 3))]
