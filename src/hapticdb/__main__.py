"""``python -m hapticdb`` is the command ``hapticdb``."""

import sys

from hapticdb import interrupting


def main() -> int:
    """Run the process's command line and return its exit code."""
    interrupting.begin()
    from hapticdb.cli import main as run  # noqa: PLC0415 - most of a start; Ctrl-C may come before

    try:
        return run()
    except KeyboardInterrupt:  # after the verb
        interrupting.print_message()
        return interrupting.EXIT_CODE
    finally:
        interrupting.leave()


if __name__ == "__main__":
    sys.exit(main())
