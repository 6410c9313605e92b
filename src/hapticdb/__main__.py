"""``python -m hapticdb`` is the command ``hapticdb``."""

import sys

from hapticdb.cli import main

sys.exit(main())
