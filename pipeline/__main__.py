"""The command ``pipeline``, and ``python -m pipeline``."""

import sys


def main() -> None:
    """Entry point. Ctrl-C while Python reads the program, half a second or so, ends it as it does later on.

    Of the processes that torchrun starts the first one is this program; the others train with it.
    """
    try:
        from stages.hardware.ranks import end_launched, launched

        if launched().rank > 0:
            from stages.train.training import follow

            follow()
            return
        from pipeline.cli import commands
    except KeyboardInterrupt:
        sys.exit(130)
    try:
        commands.main()
    finally:
        end_launched()


if __name__ == "__main__":
    main()
