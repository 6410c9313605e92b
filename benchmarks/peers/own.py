"""hapticdb itself, measured as its peers are."""

from peers import PeerWork, Pose


class Own:
    """The environment as it was given, asked by the strategy `auto`."""

    question = "the same hits and wrench, with the objects"

    def __init__(self, work: PeerWork) -> None:
        self._env = work.env
        self._shell = work.shell
        self.name = f"hapticdb, {work.env.engine}"

    def build(self, work: PeerWork) -> None:
        """Nothing: it was imported before."""

    def frame(self, pose: Pose) -> int:
        return len(self._env.touch(self._shell, pose).hits)

    def size(self) -> tuple[str, int]:
        return "file", self._env.size().bytes

    def close(self) -> None:
        """Nothing: it belongs to the caller."""
