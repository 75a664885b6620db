"""``python -m pipeline.cli.exit_with_parent WORDS``: the command line ``pipeline WORDS``, ended as by SIGTERM when the
process that holds the other end of its standard input is gone."""

import os
import signal
import sys
import threading

from pipeline.cli.commands import main


def _end_with_parent() -> None:
    while os.read(0, 1 << 12):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    threading.Thread(target=_end_with_parent, daemon=True).start()
    sys.argv[0] = "pipeline"
    main()
