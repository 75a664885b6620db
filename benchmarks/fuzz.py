"""Damaged files for every loader, for as long as asked: what it answered, refused in words, and did otherwise.

    python -m benchmarks.fuzz --minutes 60 [--only photo transforms] [--seed 0] [--keep FOLDER]

The cases are those of tests/fuzz, with new seeds. Each loader works in a child process of its own that may have so much
memory, and so many seconds of processor time a case; one that takes more is stopped, which counts as a fault, and its
files stay in FOLDER. Exit code 1 if anything went wrong.
"""

import argparse
import faulthandler
import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import seed as seeded

from benchmarks.record import Record, add_out
from tests.fuzz.loaders import LOADERS, SECONDS, attempt

MEMORY = 3 << 30  # bytes of data that a child may have; torch and its like take one gigabyte of it
ROUND_SECONDS = 60.0  # each loader in turn
EXAMPLES = 100  # of one seed
WAITS = 600.0  # seconds that a case may wait for what does not come; what it may compute is in tests/fuzz/loaders.py


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--only", nargs="*")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=Path("fuzz"))
    parser.add_argument("--child", nargs=2, help=argparse.SUPPRESS)
    add_out(parser)
    given = parser.parse_args()
    if given.child:
        print(json.dumps(attack(given.child[0], float(given.child[1]), given.seed)))
        return 0
    table = run(given.only or list(LOADERS), 60 * given.minutes, given.seed, given.keep)
    print_table(table, given.seed, given.out)
    return int(any(row["faults"] for row in table.values()))


def run(names: list[str], seconds: float, seed: int, keep: Path) -> dict[str, dict[str, Any]]:
    """Every loader in turn until the time is over; its counts by name."""
    table: dict[str, dict[str, Any]] = {n: {"tried": 0, "refused": 0, "seconds": 0.0, "faults": []} for n in names}
    share = min(ROUND_SECONDS, seconds / len(names))
    started = time.monotonic()
    while time.monotonic() - started < seconds - share / 2:
        for name in names:
            seed += 1
            answer = _child(name, share, seed, keep)
            for key, value in answer.items():
                table[name][key] += value
            print(name, seed, json.dumps(answer), file=sys.stderr, flush=True)
    return table


def _child(name: str, seconds: float, seed: int, keep: Path) -> dict[str, Any]:
    folder = keep / f"{name.replace(' ', '_')}-{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    words = [sys.executable, "-m", "benchmarks.fuzz", "--child", name, str(seconds), "--seed", str(seed)]
    started = time.monotonic()
    child = subprocess.run(words, env=os.environ | {"TMPDIR": str(folder)}, capture_output=True, text=True)
    if child.returncode == 0:
        answer = json.loads(child.stdout.splitlines()[-1])
    else:
        last = " / ".join((child.stderr.strip() or "nothing said").splitlines()[-3:])
        answer = {"tried": 0, "refused": 0, "faults": [f"ended with {child.returncode}, files in {folder}: {last}"]}
    if not answer["faults"]:
        folder.rmdir()
    return answer | {"seconds": round(time.monotonic() - started, 1)}


def attack(name: str, seconds: float, seed: int) -> dict[str, Any]:
    """What one loader did with all the cases that fit into the time."""
    loader, counts, faults = LOADERS[name], {"tried": 0, "refused": 0}, []
    faulthandler.register(signal.SIGPROF, chain=True)  # says where it was and ends the process
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))

    @settings(
        max_examples=EXAMPLES,
        database=None,
        deadline=None,
        suppress_health_check=(HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much),
        phases=(Phase.generate, Phase.shrink),
    )
    @given(files=loader.files())
    def check(files: dict[str, bytes]) -> None:
        faulthandler.dump_traceback_later(WAITS, exit=True)
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        counts["tried"] += 1
        counts["refused"] += not attempt(loader, files)
        signal.setitimer(signal.ITIMER_PROF, 0)

    started = time.monotonic()
    while time.monotonic() - started < seconds:
        seed += 1_000_003
        try:
            seeded(seed)(check)()
        except (Exception, ExceptionGroup) as fault:  # any is one: that is what is looked for
            faults += [f"seed {seed}: {_in_words(one)}" for one in _each(fault)]
    return counts | {"faults": faults}


def _each(fault: Exception) -> tuple[Exception, ...]:
    """The faults that Hypothesis found in one go: a group where they differ."""
    return fault.exceptions if isinstance(fault, ExceptionGroup) else (fault,)


def _in_words(fault: Exception) -> str:
    notes = " ".join(getattr(fault, "__notes__", ()))
    return f"{type(fault).__name__}: {str(fault)[:300]} {notes[:1000]}"


def print_table(table: dict[str, dict[str, Any]], seed: int, out: Path | None) -> None:
    """A row for each loader, and what all of them did, which is what is kept."""
    loaders, total = Record(), {"tried": 0, "refused": 0, "faults": 0}
    for name, row in table.items():
        counts = {"tried": row["tried"], "refused": row["refused"], "faults": len(row["faults"])}
        loaders.add(loader=name, **counts, seconds=round(row["seconds"]))
        total = {key: total[key] + count for key, count in counts.items()}
    Record(out).add(seeds=str(seed), **total)


if __name__ == "__main__":
    sys.exit(main())
