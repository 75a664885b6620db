"""The clock is put forward or back by a day, while a program runs or while none does."""

import json
import os
import shutil
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from pipeline.engine.cache_keys import ContentIndex
from tests.drills.campaigns import Chain
from tests.drills.drill import finished_folders, results

DAY = 86_400.0


@dataclass
class ClockPutBy:
    """In the program: after ``reads`` of the clock it is another day. Files keep the time of the system, which a test
    cannot change: their order and the program's own clock contradict each other, as after a jump."""

    seconds: float
    reads: int = 0

    def __call__(self) -> None:
        true: Callable[[], float] = time.time
        left = self.reads

        def jumped() -> float:
            nonlocal left
            left -= 1
            return true() + (self.seconds if left < 0 else 0.0)

        time.time = jumped


@pytest.mark.parametrize("jump, reads", [(-DAY, 0), (DAY, 2)], ids=["back between attempts", "forward while running"])
def test_a_clock_that_jumps(chain: Chain, tmp_path: Path, jump: float, reads: int):
    program = chain.start(
        chain.before("train", tmp_path / "w.nerf"), "--until", "train", prepare=ClockPutBy(jump, reads)
    )
    program.wait_until(lambda events: any("step" in event.get("message", "") for event in events))
    program.strike(signal.SIGKILL)
    for file in (tmp_path / "w.nerf/train").rglob("*"):  # as if they had been written before the jump
        os.utime(file, (time.time() - jump, time.time() - jump))
    began = time.monotonic()
    program = chain.start(tmp_path / "w.nerf", "--until", "train").finish()
    took = time.monotonic() - began
    folder = finished_folders(tmp_path / "w.nerf")["train"]
    assert 0 < json.loads((folder / "manifest.json").read_text())["seconds"] < took + 60
    assert all(event["seconds"] >= 0 for event in program.events() if event["event"] == "end")
    found = results(tmp_path / "w.nerf")
    assert found == {stage: chain.expected[stage] for stage in found} and "train" in found


def test_photos_exchanged_under_their_old_size_and_date(chain: Chain, tmp_path: Path):
    shutil.copytree(chain.photos, tmp_path / "photos")
    photo = tmp_path / "photos/train/r_0.png"
    index = ContentIndex(tmp_path / "index")
    before, stat = index.sha256(photo), photo.stat()
    index.save()
    content = bytearray(photo.read_bytes())
    content[-20] ^= 1
    photo.write_bytes(content)
    os.utime(photo, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert (photo.stat().st_size, photo.stat().st_mtime_ns) == (stat.st_size, stat.st_mtime_ns)
    assert ContentIndex(tmp_path / "index").sha256(photo) != before
