import subprocess
import sys
from pathlib import Path

import pycolmap

from stages.sfm.colmap.database.files import keep_open
from tests.stages.sfm.colmap.conftest import COUNT

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
