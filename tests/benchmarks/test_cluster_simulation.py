"""The simulated cluster keeps the laws of the real one."""

import pytest

from benchmarks.cluster_simulation import Cluster, Failures, Machine, Memory, Piece, Run, Stage, simulate
from stages.hardware.cluster import MAX_RETRIES

WORK = [float(seconds % 7 + 1) for seconds in range(50)]
SEQUENTIAL = Stage("mapping", alone=100.0)
SHARED = Stage("matching", pieces=[Piece(seconds) for seconds in WORK])
FAILING = Failures(hours=20 / 3600, away_seconds=5.0)


def cluster(count: int, failures: Failures | None = None) -> Cluster:
    return Cluster((Machine(slots=1, cores=2),) * count, failures=failures)


def taken(stages: list[Stage], of: Cluster, seed: int = 0) -> Run:
    return simulate(stages, of, seed)


def test_one_machine_takes_the_sum_of_all_work():
    assert taken([SEQUENTIAL, SHARED], cluster(1)).whole == pytest.approx(100 + sum(WORK))


def test_many_machines_leave_the_sequential_part():
    assert taken([SEQUENTIAL, SHARED], cluster(1000)).whole == pytest.approx(100 + max(WORK))


def test_two_machines_halve_equal_pieces():
    stage = Stage("stereo", pieces=[Piece(2.0)] * 10)
    assert taken([stage], cluster(2)).whole == pytest.approx(10)


def test_a_slow_machine_gets_fewer_pieces():
    stage = Stage("stereo", pieces=[Piece(1.0)] * 400)
    slow = Cluster((Machine(slots=1), Machine(slots=1, speed=1 / 3)))
    assert taken([stage], slow).whole == pytest.approx(300, abs=3)


def test_what_the_head_does_bounds_a_stage():
    stage = Stage("matching", pieces=[Piece(1.0, before=0.5, after=0.25)] * 100)
    assert 75 <= taken([stage], cluster(64)).whole < 78


def test_the_link_bounds_what_others_read():
    stage = Stage("stereo", pieces=[Piece(0.1, bytes=1e9)] * 20, whole_machines=True)
    run = taken([stage], Cluster((Machine(slots=1),) * 8, link=1e9))
    assert run.bytes <= 20e9 and run.whole >= run.bytes / 1e9


def test_work_of_failed_machines_is_done_again():
    still, failing = taken([SHARED], cluster(4)), taken([SHARED], cluster(4, FAILING))
    assert failing.again > 0 and failing.given_up == 0
    assert failing.busy.sum() > still.busy.sum() == pytest.approx(sum(WORK))
    assert failing.whole > still.whole


def test_kept_work_is_not_done_again():
    alike = [Piece(40.0)] * 20
    kept = [piece._replace(kept=tuple(map(float, range(40)))) for piece in alike]
    each = [taken([Stage("scenes", pieces=pieces)], cluster(4, FAILING)) for pieces in (alike, kept)]
    assert each[1].busy.sum() < each[0].busy.sum()


def test_pieces_are_given_up_after_all_retries():
    stage = Stage("scenes", pieces=[Piece(1e4)] * 2)
    run = taken([stage], cluster(2, Failures(hours=1 / 3600, away_seconds=1.0)))
    assert run.given_up == 1 and run.again == MAX_RETRIES + 1


def test_equal_seeds_give_equal_runs():
    runs = [taken([SEQUENTIAL, SHARED], cluster(4, FAILING), seed) for seed in (1, 1, 2)]
    assert runs[0].seconds == runs[1].seconds != runs[2].seconds


def test_shared_values_travel_once_to_each_machine():
    stage = Stage("matching", pieces=[Piece(1.0, needs=(1, 2))] * 40, shared_bytes=1e6)
    assert taken([stage, stage], cluster(4)).bytes == 3 * 2e6


def test_memory_reads_forgotten_photos_again():
    memory = Memory(photo_bytes=1e9)
    assert [memory.value(0), memory.value(0)] == [(1, True), (1, False)]
    for photo in range(1, memory.room + 1):
        memory.value(photo)
    assert memory.value(0) == (memory.room + 2, True)
