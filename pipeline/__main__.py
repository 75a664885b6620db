"""The command ``pipeline``, and ``python -m pipeline``."""

import sys


def main() -> None:
    """Entry point. Ctrl-C while Python reads the program, half a second or so, ends it as it does later on."""
    try:
        from pipeline.cli import commands
    except KeyboardInterrupt:
        sys.exit(130)
    commands.main()


if __name__ == "__main__":
    main()
