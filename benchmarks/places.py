"""The tests' servers of PostgreSQL, which benchmarks use, too."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parent.parent / "tests"))

from postgres_servers import PORT, USER, Binaries, Server, find_binaries, serving

__all__ = ["PORT", "USER", "Binaries", "Server", "find_binaries", "serving"]
