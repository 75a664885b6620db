"""Numbers beside the points of a study's plot."""

from stages.tradeoff.plots import NUMBER_SIZE, Label, merge_labels


def test_numbers_of_points_that_lie_together_stand_side_by_side() -> None:
    together = [Label(300.0, 50.0, (17,)), Label(305.0, 49.0, (19,)), Label(302.0, 50.5, (18,))]
    above, beside = Label(301.0, 50.0 + 2 * NUMBER_SIZE, (5,)), Label(290.0, 50.0, (9,))
    joined = Label(305.0, 49.0, (17, 18, 19))
    assert sorted(merge_labels([*together, above, beside])) == sorted([joined, above, beside])
    assert merge_labels([]) == []


def test_what_a_longer_label_comes_to_lie_on_joins_it() -> None:
    first, second, third = (
        Label(x, 0.0, (number,)) for x, number in ((0.0, 1), (3.0, 2), (3.0 + 1.5 * NUMBER_SIZE, 3))
    )
    assert merge_labels([first, third]) == [first, third]
    assert merge_labels([second, third]) == [second, third]
    assert merge_labels([first, second, third]) == [Label(third.x, 0.0, (1, 2, 3))]
