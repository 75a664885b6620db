"""How long runs would take on clusters that nobody here has: a simulation, event by event, of what fan_out does.

    python -m benchmarks.cluster_simulation [--out benchmarks/results/cluster_simulation.json]
        [--plot docs/images/cluster_simulation.png]

Costs are those of cluster_costs.json (python -m benchmarks.cluster_costs) and of the files beside it. One machine, the
head, gives the command: its driver prepares pieces of work and writes results, and its cores work, too. All else is as
stages/hardware/cluster.py has it: as many pieces under way as there are slots, and work of a machine that fails is done
again. Bytes that other machines need or return go through the head's one network link. Rows: "check" compares with real
runs, the others are predictions. The same seed gives the same rows.
"""

import argparse
import heapq
import json
import math
from collections import OrderedDict, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.record import Record, add_out, as_json, provenance
from stages.hardware.cluster import MAX_RETRIES, MAX_WAITING
from stages.sfm.colmap.database.extraction import PHOTOS_AT_A_TIME
from stages.sfm.colmap.database.features import CACHE_SHARE, MIN_CACHED_PHOTOS
from stages.sfm.colmap.database.matching import BLOCK_SIZE
from stages.sfm.pairs.image_retrieval import WORDS

RESULTS = Path(__file__).parent / "results"
RESULT_BYTES, WAITS = 1_250_000, (0.2, 0.4, 0.6, 0.8)  # of pieces that only wait; two photos' features are as large
MACHINES = (1, 2, 4, 8, 16, 32, 64)
CORES = 2  # of a machine: as of the one that costs were measured on
SLOW_SPEED = 1 / 3
LINK_BYTES_PER_SECOND = 1.25e8  # 1 Gbit/s, what a plain network has; not measured
HOURS_BETWEEN_FAILURES, AWAY_SECONDS = 1.0, 300.0  # of a machine, in the mean; how long it is gone then
CONDITIONS = ("alike", "one slow", "failing", "10 Gbit/s")
FAST_LINK_BYTES_PER_SECOND = 1.25e9
KEPT_SECONDS = 30.0  # between checkpoints
SCENE_SPREAD = 0.25  # deviation of the logarithm of a scene's seconds; assumed
WORKSPACE_BYTES = 2.5e8  # of a finished scene with its pixel store; that of fern is 1.6e8
SMALLER, LARGEST, BATCH = "1,000 photos", "10,000 photos", "100 scenes of 100 photos"
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#999999", "#7f3c8d", "#806000")
TICKS = {60: "1 min", 600: "10 min", 1800: "30 min", 3600: "1 h", 3 * 3600: "3 h", 8 * 3600: "8 h", 24 * 3600: "1 d"}


# --- the cluster


class Machine(NamedTuple):
    """How many pieces it does at a time, its cores, and its speed: 1 is that of the machine of the costs."""

    slots: int = CORES
    cores: int = CORES
    speed: float = 1.0


class Failures(NamedTuple):
    """Hours between two failures of a machine in the mean, and seconds until it is back. The head never fails."""

    hours: float = HOURS_BETWEEN_FAILURES
    away_seconds: float = AWAY_SECONDS


@dataclass(frozen=True)
class Cluster:
    """Machines, the first being the head. Seconds of giving work away: ``first_seconds`` begins a process,
    ``piece_seconds`` pass with each piece in its slot, ``driver_seconds`` at the head."""

    machines: tuple[Machine, ...]
    first_seconds: float = 0.0
    piece_seconds: float = 0.0
    driver_seconds: float = 0.0
    link: float = LINK_BYTES_PER_SECOND
    failures: Failures | None = None


class Piece(NamedTuple):
    """A piece of work: seconds in a slot of speed 1, those of the head before and after it, numbers of the shared
    values that its machine has to have, bytes that it reads and returns, and after which seconds of it a further try
    need not begin at nought."""

    seconds: float
    before: float = 0.0
    after: float = 0.0
    needs: tuple[int, ...] = ()
    bytes: float = 0.0
    kept: tuple[float, ...] = ()


@dataclass
class Outcome:
    """What a call of fan_out took: seconds of the clock, busy seconds of each machine's slots, of the driver and of
    the link, bytes moved, pieces begun again, and pieces given up after MAX_RETRIES."""

    seconds: float = 0.0
    busy: list[float] = field(default_factory=list)
    driver: float = 0.0
    link: float = 0.0
    bytes: float = 0.0
    again: int = 0
    given_up: int = 0


@dataclass
class State:
    """A machine as it is: pieces at work with their beginning, shared values that it has, processes begun. Values and
    processes stay from one call of fan_out to the next."""

    of: Machine
    running: dict[int, float] = field(default_factory=dict)
    has: set[int] = field(default_factory=set)
    processes: int = 0
    alive: bool = True

    @property
    def free(self) -> int:
        return self.of.slots - len(self.running) if self.alive else 0


class FanOut:
    """One call of fan_out for the pieces of a stage, by machines whose states it changes."""

    def __init__(self, cluster: Cluster, stage: "Stage", machines: list[State], random: np.random.Generator) -> None:
        self.cluster, self.pieces, self.shared_bytes = cluster, stage.pieces, stage.shared_bytes
        self.machines, self.random, pieces = machines, random, stage.pieces
        for machine in machines:
            machine.alive = True
        self.left_over = [piece.seconds for piece in pieces]  # of work, at speed 1
        self.tries = [0] * len(pieces)
        self.queue, self.done = deque[int](), deque[int]()
        self.events: list[tuple[float, int, str, int, int, int]] = []
        self.order, self.now, self.link_free = 0, 0.0, 0.0
        self.outcome = Outcome(busy=[0.0] * len(self.machines))

    def run(self) -> Outcome:
        """The driver's loop: give away while slots are free, else take the next result."""
        limit = sum(machine.of.slots for machine in self.machines)
        for number in range(1, len(self.machines)):
            self._plan_failure(0.0, number)
        given, taken, oldest, finished = 0, 0, 0, [False] * len(self.pieces)
        while taken < len(self.pieces):
            ahead = given < len(self.pieces) and given - taken < limit and given - oldest < MAX_WAITING * limit
            if ahead:
                self._work(self.pieces[given].before)
                self.queue.append(given)
                self._start()
                given += 1
            elif self.done:
                number = self.done.popleft()
                self._work(self.pieces[number].after + self.cluster.driver_seconds)
                finished[number], taken = True, taken + 1
                while oldest < given and finished[oldest]:
                    oldest += 1
            else:
                self._advance(self.events[0][0])
        self.outcome.seconds = self.now
        return self.outcome

    def _work(self, seconds: float) -> None:
        """The driver works so long."""
        taken = seconds * self._crowded()
        self.outcome.driver += taken
        self._advance(self.now + taken)

    def _crowded(self) -> float:
        """How much longer all work at the head takes, where its pieces and the driver want more than its cores."""
        driver = self.outcome.driver / self.now if self.now else 0.0
        return max(1.0, (len(self.machines[0].running) + driver) / self.machines[0].of.cores)

    def _advance(self, until: float) -> None:
        """Everything that happens until then."""
        while self.events and self.events[0][0] <= until:
            time, _, kind, machine, number, attempt = heapq.heappop(self.events)
            self.now = max(self.now, time)
            if kind == "done":
                self._end(time, machine, number, attempt)
            elif kind == "fail":
                self._fail(time, machine)
            else:
                self.machines[machine].alive = True
                self._plan_failure(time, machine)
            self._start()
        self.now = max(self.now, until)

    def _push(self, time: float, kind: str, machine: int, number: int = 0, attempt: int = 0) -> None:
        self.order += 1
        heapq.heappush(self.events, (time, self.order, kind, machine, number, attempt))

    def _start(self) -> None:
        """Pieces that wait begin on the machines with most free slots."""
        while self.queue:
            number = max(range(len(self.machines)), key=lambda i: (self.machines[i].free, -i))
            if not self.machines[number].free:
                return
            self._begin(self.queue.popleft(), number)

    def _begin(self, piece: int, number: int) -> None:
        machine, work, start = self.machines[number], self.pieces[piece], self.now
        if number:
            missing = [value for value in work.needs if value not in machine.has]
            moved = work.bytes + len(missing) * self.shared_bytes
            machine.has.update(missing)
            if moved:
                start = max(start, self.link_free) + moved / self.cluster.link
                self.link_free = start
                self.outcome.bytes += moved
                self.outcome.link += moved / self.cluster.link
        overhead = self.cluster.piece_seconds
        if machine.processes < machine.of.slots:
            machine.processes += 1
            overhead += self.cluster.first_seconds
        taken = (self.left_over[piece] + overhead) / machine.of.speed
        machine.running[piece] = start
        if not number:
            taken *= self._crowded()
        self._push(start + taken, "done", number, piece, self.tries[piece])

    def _end(self, time: float, number: int, piece: int, attempt: int) -> None:
        machine = self.machines[number]
        if attempt != self.tries[piece] or piece not in machine.running:
            return  # its machine failed before
        self.outcome.busy[number] += time - machine.running.pop(piece)
        self.done.append(piece)

    def _plan_failure(self, time: float, number: int) -> None:
        if self.cluster.failures:
            self._push(time + self.random.exponential(3600 * self.cluster.failures.hours), "fail", number)

    def _fail(self, time: float, number: int) -> None:
        """A machine is gone: what it was doing waits for another one, before all else."""
        machine = self.machines[number]
        assert self.cluster.failures
        for piece, began in machine.running.items():
            worked = max(0.0, time - began)  # it may have waited for the link
            self.outcome.busy[number] += worked
            self.tries[piece] += 1
            self.outcome.again += 1
            if self.tries[piece] > MAX_RETRIES:
                self.outcome.given_up += 1
                self.done.append(piece)
                continue
            whole = self.pieces[piece]
            reached = whole.seconds - self.left_over[piece] + worked * machine.of.speed
            self.left_over[piece] = whole.seconds - max((at for at in whole.kept if at <= reached), default=0.0)
            self.queue.appendleft(piece)
        machine.running, machine.has, machine.processes, machine.alive = {}, set(), 0, False
        self._push(time + self.cluster.failures.away_seconds, "back", number)


# --- the costs


def figures(name: str) -> list[dict[str, Any]]:
    """The rows of a file of results."""
    return json.loads((RESULTS / f"{name}.json").read_text("utf-8"))["figures"]


def row(name: str, **wanted: Any) -> dict[str, Any]:
    """The last row with these figures."""
    return [each for each in figures(name) if wanted.items() <= each.items()][-1]


def by_photos(what: str) -> list[dict[str, Any]]:
    """Such rows of the costs, fewest photos first."""
    return sorted((each for each in figures("cluster_costs") if each["what"] == what), key=lambda each: each["photos"])


def power(below: dict[str, Any], above: dict[str, Any], key: str) -> float:
    """The exponent of photos by which a figure grows from one row to the other."""
    return math.log(above[key] / below[key]) / math.log(above["photos"] / below["photos"])


class Giving(NamedTuple):
    """Seconds of giving work away (see Cluster), and of a megabyte that comes back or is shared, at the head."""

    first: float
    piece: float
    driver: float
    result_megabyte: float
    share_megabyte: float

    @staticmethod
    def measured(workers: int) -> "Giving":
        """By a cluster of so many workers. What a piece takes beside the driver's work passes in its slot."""
        one = row("cluster_costs", what="giving away", workers=workers)
        driver = one["driver_piece_seconds"]
        in_slot = max(0.0, row("cluster_costs", what="giving away", workers=1)["piece_seconds"] - driver)
        return Giving(
            one["first_seconds"], in_slot, driver, one["result_megabyte_seconds"], one["share_megabyte_seconds"]
        )

    def cluster(self, machines: Sequence[Machine], failures: Failures | None = None) -> Cluster:
        """A cluster where giving away takes so much."""
        return Cluster(tuple(machines), self.first, self.piece, self.driver, failures=failures)


class Stage(NamedTuple):
    """Seconds that the head works alone, or pieces to give away, to slots or to whole machines."""

    name: str
    alone: float = 0.0
    pieces: Sequence[Piece] = ()
    shared_bytes: float = 0.0
    whole_machines: bool = False


ROUNDS = (5, 3, 2, 2, 2, 2)  # pairs of each photo that a round of matching adds: 16 in all, as of bonsai_120
TIMED = ("sfm", "train", "evaluate", "render", "mesh")  # stages of a whole run; the others take as long for any number
DESCRIPTOR = 128  # bytes of a feature
CANDIDATE_BYTES, AGREED_SHARE = 12, 0.1  # of a pixel of a pair's photo; of a pair's seconds the driver's, assumed
STEREO_PAIRS = 2.5  # of a photo (depth_maps.json: 106 of 43)
TEST_EVERY = 8
MIN_SCORE_SECONDS = 0.2  # of a test photo, however few of its pixels are rendered; assumed
MEMORY_BYTES = 20e9  # of the head, free


def features(costs: dict[str, Any], giving: Giving, photos: int) -> Stage:
    """Two photos to a slot."""
    back = costs["index_bytes"] / 4  # descriptors as bytes, not as float32
    together = Piece(
        PHOTOS_AT_A_TIME * costs["features_seconds"],
        after=PHOTOS_AT_A_TIME * (costs["write_features_seconds"] + back / 1e6 * giving.result_megabyte),
        bytes=PHOTOS_AT_A_TIME * (costs["file_bytes"] + back),
    )
    return Stage("features", pieces=[together] * -(-photos // PHOTOS_AT_A_TIME))


def pairs_of(photos: int, nearest: int, farthest: int, order: np.ndarray) -> list[tuple[int, int]]:
    """Each photo with those so far away in the sequence in which they were taken; ``order`` gives their numbers."""
    steps = range(nearest, farthest + 1)
    found = [np.stack([order[:-step], order[step:]], axis=1) for step in steps if step < photos]
    return sorted(map(tuple, np.sort(np.concatenate(found), axis=1).tolist()))


class Memory:
    """The photos' features that the head keeps at hand (database.Features): the latest that fit."""

    def __init__(self, photo_bytes: float) -> None:
        self.room = max(MIN_CACHED_PHOTOS, int(CACHE_SHARE * MEMORY_BYTES / photo_bytes))
        self.kept, self.read = OrderedDict[int, int](), 0

    def value(self, photo: int) -> tuple[int, bool]:
        """The number of the shared value of a photo, and whether it had to be read for it."""
        fresh = photo not in self.kept
        if fresh:
            self.read += 1
        self.kept[photo] = self.kept.pop(photo, self.read)
        if len(self.kept) > self.room:
            self.kept.popitem(last=False)
        return self.kept[photo], fresh


def matching(
    costs: dict[str, Any], giving: Giving, pairs: Sequence[tuple[int, int]], memory: Memory, way: str
) -> Stage:
    """32 pairs to a slot; ``way``: match, or match_indexed."""
    indexed = way == "match_indexed"
    size = costs["index_bytes" if indexed else "read_bytes"]
    reading = costs["index_seconds" if indexed else "read_seconds"] + size / 1e6 * giving.share_megabyte
    pieces = []
    for begin in range(0, len(pairs), BLOCK_SIZE):
        block = pairs[begin : begin + BLOCK_SIZE]
        values = [memory.value(photo) for pair in block for photo in pair]
        needs = tuple(dict.fromkeys(number for number, _ in values))
        before, after = reading * sum(fresh for _, fresh in values), len(block) * costs["write_pair_seconds"]
        pieces.append(Piece(len(block) * costs[f"{way}_seconds"], before, after, needs))
    return Stage("matching", pieces=pieces, shared_bytes=size)


def scene(photos: int, giving: Giving, in_order: bool = True, exponent: float = 1.0) -> list[Stage]:
    """The stages of a run from photos to scores with depth maps, photos as those of bonsai_120. ``in_order``: their
    names are in the order in which they were taken; ``exponent``: of photos, by which mapping and adjustment grow."""
    costs = row("cluster_costs", what="costs", set="bonsai_120", busy_cores=1)
    phases, whole = row("cluster_costs", what="phases", set="bonsai"), row("whole_runs", set="bonsai_120")
    growth, (smaller, graph) = photos / phases["photos"], by_photos("graph")[-2:]
    chosen = graph["seconds"] * (photos / graph["photos"]) ** power(smaller, graph, "seconds")
    order = np.arange(photos) if in_order else np.random.default_rng(0).permutation(photos)
    stages = [
        Stage("ingest", phases["ingest_seconds"] * growth),
        features(costs, giving, photos),
        Stage("pair selection", retrieval(costs, photos)),
    ]
    memory, nearest = Memory(costs["index_bytes"]), 1
    for more in ROUNDS:
        pairs = pairs_of(photos, nearest, nearest + more - 1, order)
        stages += [matching(costs, giving, pairs, memory, "match_indexed"), Stage("pair selection", chosen)]
        nearest += more
    stages += [
        Stage("mapping", phases["mapping_seconds"] * growth**exponent),
        Stage("final adjustment", phases["finish_seconds"] * growth**exponent),
        *depth(photos, costs),
        Stage("other stages", whole["whole_seconds"] - sum(whole[f"{name}_seconds"] for name in TIMED)),
        Stage("training", float(whole["train_seconds"])),
        scores(photos, whole["evaluate_seconds"], costs),
    ]
    return stages


def retrieval(costs: dict[str, Any], photos: int) -> float:
    """Seconds of two vocabularies, of each photo's vector, and of all their products."""
    rate = 1e9 * row("machine_rates")["width_256_gflops"]
    products = 2 * photos**2 * WORDS * DESCRIPTOR / rate
    return 2 * costs["vocabulary_seconds"] + photos * costs["retrieval_seconds"] + products


def depth(photos: int, costs: dict[str, Any]) -> list[Stage]:
    """Stereo by pairs, then points by the head."""
    maps = row("depth_maps", set="fox")
    width, height = map(int, maps["size"].split(" × "))
    moved = 2 * costs["file_bytes"] + 2 * CANDIDATE_BYTES * width * height
    pair = Piece((1 - AGREED_SHARE) * maps["pair_seconds"], after=AGREED_SHARE * maps["pair_seconds"], bytes=moved)
    return [
        Stage("stereo", pieces=[pair] * round(STEREO_PAIRS * photos)),
        Stage("point cloud", maps["fusion_seconds"] * photos / CORES),
    ]


def scores(photos: int, seconds: float, costs: dict[str, Any]) -> Stage:
    """Test photos, each to a machine. Their pixels are chosen so that all take about as long as those of bonsai_120."""
    count = -(-photos // TEST_EVERY)
    each = Piece(max(seconds / count, MIN_SCORE_SECONDS), bytes=costs["file_bytes"])
    return Stage("scores", pieces=[each] * count, whole_machines=True)


# --- runs


@dataclass
class Run:
    """A simulated run: seconds, occupied share and limit of each stage by name, and what was moved and begun again."""

    seconds: dict[str, float] = field(default_factory=dict)
    limits: dict[str, str] = field(default_factory=dict)
    busy: np.ndarray = field(default_factory=lambda: np.zeros(1))  # seconds of each machine, all of its slots
    bytes: float = 0.0
    again: int = 0
    given_up: int = 0

    @property
    def whole(self) -> float:
        return sum(self.seconds.values())

    @property
    def bottleneck(self) -> str:
        """The longest stage, and what it waits for."""
        longest = max(self.seconds, key=self.seconds.__getitem__)
        return f"{longest}: {self.limits[longest]}"


def limit(outcome: Outcome, slots: int) -> str:
    """What a call of fan_out waited for most: the cores, the head's preparing and writing, its link, or the last
    pieces."""
    shares = {
        "the driver": outcome.driver / outcome.seconds,
        "the link": outcome.link / outcome.seconds,
        "cores": sum(outcome.busy) / slots / outcome.seconds,
    }
    most = max(shares, key=shares.__getitem__)
    return most if shares[most] > 0.7 else "the last pieces"


def simulate(stages: Sequence[Stage], cluster: Cluster, seed: int = 0) -> Run:
    """One stage after the other."""
    random, run = np.random.default_rng(seed), Run(busy=np.zeros(len(cluster.machines)))
    slots = [State(machine) for machine in cluster.machines]
    whole = [State(machine._replace(slots=1)) for machine in cluster.machines]  # other processes
    for stage in stages:
        taken, limited = stage.alone, "the head alone"
        run.busy[0] += stage.alone
        if stage.pieces:
            states = whole if stage.whole_machines else slots
            outcome = FanOut(cluster, stage, states, random).run()
            run.busy += np.array(outcome.busy) / [state.of.slots for state in states]
            run.bytes, run.again = run.bytes + outcome.bytes, run.again + outcome.again
            run.given_up += outcome.given_up
            taken, limited = outcome.seconds, limit(outcome, sum(state.of.slots for state in states))
        if taken >= run.seconds.get(stage.name, 0.0):
            run.limits[stage.name] = limited
        run.seconds[stage.name] = run.seconds.get(stage.name, 0.0) + taken
    return run


def cluster_of(count: int, condition: str, giving: Giving) -> Cluster:
    """So many machines under one of the CONDITIONS."""
    every = [Machine()] * count
    if condition == "one slow":
        every[-1] = Machine(speed=SLOW_SPEED)
    cluster = giving.cluster(every, Failures() if condition == "failing" else None)
    return replace(cluster, link=FAST_LINK_BYTES_PER_SECOND) if condition == "10 Gbit/s" else cluster


def locally(stages: Sequence[Stage]) -> list[tuple[float, float]]:
    """Seconds of each stage on one machine without a cluster, and how much of its work at most is lost with it."""
    taken = []
    for stage in stages:
        own = sum(piece.seconds for piece in stage.pieces) / (1 if stage.whole_machines else CORES) + stage.alone
        resumes = stage.name in ("features", "matching", "stereo", "training")
        taken.append((own, KEPT_SECONDS if resumes else own))
    return taken


def scene_pieces(count: int, photos: int, giving: Giving, seed: int) -> list[Piece]:
    """Whole runs of so many scenes, each of them by one machine; a further try goes on from the last finished stage,
    or nearly where it was in those that resume."""
    costs = row("cluster_costs", what="costs", set="bonsai_120", busy_cores=1)
    whole = row("whole_runs", set="bonsai_120")
    named = [stage for stage in scene(photos, giving) if stage.name not in ("stereo", "point cloud")]
    stages = [*locally(named), *((float(whole[f"{name}_seconds"]),) * 2 for name in ("render", "mesh"))]
    random, pieces = np.random.default_rng(seed), []
    for spread in np.exp(random.normal(0.0, SCENE_SPREAD, count)):
        at, kept = 0.0, list[float]()
        for seconds, lost in stages:
            kept += list(np.arange(at, at + seconds * spread, max(lost * spread, 1.0)))
            at += seconds * spread
        pieces.append(Piece(at, bytes=photos * costs["file_bytes"] + WORKSPACE_BYTES, kept=tuple(kept)))
    return pieces


# --- rows


def checks() -> Iterator[dict[str, Any]]:
    """Real runs of this machine beside what is simulated for them."""
    for real in (each for each in figures("cluster_costs") if each["what"] == "run"):
        workers, photos = real["workers"], real["photos"]
        costs = row("cluster_costs", what="costs", set=real["set"], busy_cores=1)
        for name, simulated in check(costs, photos, workers).items():
            measured = real[f"{name}_seconds"]
            off = round(100 * (simulated / measured - 1), 1)
            took = {"measured_seconds": measured, "simulated_seconds": round(simulated, 1), "off_percent": off}
            took["load"] = real["load"]
            yield {"what": "check", "work": name, "set": real["set"], "photos": photos, "workers": workers, **took}
    giving = Giving.measured(1)._replace(first=0.0)  # the processes had begun
    for real in (each for each in figures("cluster_costs") if each["what"] == "waits"):
        after = RESULT_BYTES / 1e6 * giving.result_megabyte
        pieces = [Piece(WAITS[number % len(WAITS)], after=after) for number in range(real["pieces"])]
        cluster = giving.cluster([Machine(slots=1)] * real["workers"])
        simulated = simulate([Stage("waits", pieces=pieces)], cluster).whole
        took = {"measured_seconds": real["seconds"], "simulated_seconds": round(simulated, 1)}
        off = round(100 * (simulated / real["seconds"] - 1), 1)
        yield {"what": "check", "work": "waits", "workers": real["workers"], **took, "off_percent": off}


def check(costs: dict[str, Any], photos: int, workers: int) -> dict[str, float]:
    """Seconds of features and of matching all pairs, exact and indexed, by the two cores of one machine."""
    if not workers:
        pairs = photos * (photos - 1) // 2
        wrote = costs["write_pair_seconds"] * pairs
        read, index = photos * costs["read_seconds"], photos * costs["index_seconds"]
        return {
            "features": photos * (costs["features_seconds"] + costs["write_features_seconds"]) / CORES,
            "match": (pairs * costs["match_seconds"] + wrote + read) / CORES,
            "match_indexed": (pairs * costs["match_indexed_seconds"] + wrote + index) / CORES,
        }
    giving = Giving.measured(workers)
    cluster = giving.cluster([Machine(slots=workers)])
    pairs = pairs_of(photos, 1, photos - 1, np.arange(photos))
    stages = [features(costs, giving, photos)]
    for way, size in (("match", costs["read_bytes"]), ("match_indexed", costs["index_bytes"])):
        stages.append(matching(costs, giving, pairs, Memory(size), way)._replace(name=way))
    return simulate(stages, cluster).seconds


def figures_of(run: Run, alone: float) -> dict[str, Any]:
    """What a row says of a run; ``alone`` are the seconds of one machine."""
    busy = 100 * run.busy / run.whole
    others = busy[1:] if len(busy) > 1 else busy
    return {
        "seconds": round(run.whole),
        "speed_up": round(alone / run.whole, 2),
        "moved_gb": round(run.bytes / 1e9, 2),
        "head_busy_percent": round(float(busy[0]), 1),
        "others_busy_percent": round(float(others.mean()), 1),
        "least_busy_percent": round(float(others.min()), 1),
        "begun_again": run.again,
        "given_up": run.given_up,
        "bottleneck": run.bottleneck,
        **{f"{name.replace(' ', '_')}_seconds": round(seconds, 1) for name, seconds in run.seconds.items()},
        "limits": "; ".join(f"{name}: {what}" for name, what in run.limits.items() if what != "the head alone"),
    }


def sweep(name: str, stages: Sequence[Stage], giving: Giving) -> Iterator[dict[str, Any]]:
    """Rows for every number of machines and every condition."""
    alone = 0.0
    for count in MACHINES:
        for condition in CONDITIONS if count > 1 else CONDITIONS[:1]:
            run = simulate(stages, cluster_of(count, condition, giving), seed=count)
            alone = alone or run.whole
            yield {"what": name, "machines": count, "condition": condition, **figures_of(run, alone)}


# --- the plot


def plot(rows: Sequence[dict[str, Any]], file: Path) -> None:
    """Seconds against machines, both logarithmic: whole runs at the left, stages of the largest one at the right."""
    figure = Figure(figsize=(9, 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    for name, colour in zip((SMALLER, LARGEST, BATCH), COLOURS, strict=False):
        for condition, style in (("alike", "-"), ("one slow", ":"), ("failing", "--")):
            some = [each for each in rows if each["what"] == name and each["condition"] == condition]
            label = name if condition == "alike" else None
            left.loglog([r["machines"] for r in some], [r["seconds"] for r in some], style, color=colour, label=label)
    left.set(title="whole runs (dotted: one slow; dashed: failing)")
    largest = [each for each in rows if each["what"] == LARGEST and each["condition"] == "alike"]
    stages = [key for key in largest[0] if key.endswith("_seconds") and key != "other_stages_seconds"]
    for stage, colour in zip(sorted(stages, key=lambda key: -largest[-1][key]), COLOURS, strict=True):
        took, label = [each[stage] for each in largest], stage.removesuffix("_seconds").replace("_", " ")
        right.loglog([each["machines"] for each in largest], took, color=colour, label=label)
    right.set(title=f"stages of {LARGEST}")
    for axes in (left, right):
        axes.set_xticks(MACHINES, [str(count) for count in MACHINES])
        lowest, highest = axes.get_ylim()
        ticks = {at: label for at, label in TICKS.items() if lowest < at < highest}
        axes.set_yticks([*ticks], [*ticks.values()])
        axes.minorticks_off()
        axes.set_xlabel(f"machines of {CORES} cores")
        axes.title.set_fontsize(9)
    left.legend(fontsize=7)
    right.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(file, dpi=80, facecolor="#ffffff", metadata={"Software": None})


def main() -> None:
    """Check, then sweep."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plot", type=Path)
    add_out(parser)
    given, giving, rows = parser.parse_args(), Giving.measured(CORES), list[dict[str, Any]]()
    batch = Stage("scenes", pieces=scene_pieces(100, 100, giving, seed=0), whole_machines=True)
    for table in (
        checks(),
        sweep(SMALLER, scene(1_000, giving), giving),
        sweep(LARGEST, scene(10_000, giving), giving),
        sweep(f"{LARGEST}, names in no order", scene(10_000, giving, in_order=False), giving),
        sweep(f"{LARGEST}, mapping by photos^1.5", scene(10_000, giving, exponent=1.5), giving),
        sweep(BATCH, [batch], giving),
    ):
        record = Record()
        for figures_of_row in table:
            record.add(**figures_of_row)
        rows += map(dict, record.figures)
    if given.out:
        given.out.write_text(as_json(provenance() | {"figures": rows}), "utf-8")
    if given.plot:
        plot(rows, given.plot)


if __name__ == "__main__":
    main()
