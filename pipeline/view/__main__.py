"""The server of `pipeline run --view`: says its address in a line of JSON and ends after its standard input."""

import json
import sys
from contextlib import suppress
from pathlib import Path

from pipeline.view.server import ViewServer


def main() -> None:
    """``python -m pipeline.view WORKSPACE``."""
    server = ViewServer(Path(sys.argv[1]))
    print(json.dumps({"url": server.url}), flush=True)
    server.stop_after(sys.stdin.buffer)
    with suppress(KeyboardInterrupt):  # the terminal's, which ends the run as well
        server.run()


if __name__ == "__main__":
    main()
