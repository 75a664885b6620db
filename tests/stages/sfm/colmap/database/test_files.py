import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pycolmap

from stages.sfm.colmap.database.files import keep_open
from stages.sfm.colmap.database.thinning import thin_matches
from tests.stages.sfm.colmap.conftest import COUNT
from tests.stages.sfm.colmap.made_models import (
    Made,
)

READER = """
import sys
from pathlib import Path
from stages.sfm.registration import count_done
print("ready", flush=True)
while True:
    count_done(Path(sys.argv[1]))
"""


def test_an_open_database_can_be_read_along(database: Path) -> None:
    reader = subprocess.Popen(
        [sys.executable, "-c", READER, str(database)], stdout=subprocess.PIPE, cwd=Path(__file__).parents[5]
    )
    try:
        assert reader.stdout and reader.stdout.readline() == b"ready\n"
        held = keep_open(database)
        for _ in range(500):  # without it one in ten or twenty fails
            with pycolmap.Database.open(database) as db:
                assert db.num_images() == COUNT
        held.close()
    finally:
        reader.kill()
        reader.wait()


def test_a_killed_copys_log_is_not_reused(made: Made, tmp_path: Path) -> None:
    copy, log = tmp_path / "thinned.db", tmp_path / "thinned.db-wal"
    thin_matches(made.database, copy)
    with closing(sqlite3.connect(copy)) as killed:
        killed.execute("pragma journal_mode=wal")
        killed.execute("create table left_behind as select * from matches")
        killed.commit()
        left = log.read_bytes()
    log.write_bytes(left)
    thin_matches(made.database, copy)
    with closing(sqlite3.connect(copy)) as database:
        assert database.execute("pragma integrity_check").fetchall() == [("ok",)]
        assert not database.execute("select name from sqlite_master where name = 'left_behind'").fetchall()
