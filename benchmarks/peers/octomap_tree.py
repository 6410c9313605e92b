"""OctoMap: an octree in memory, as robots map what they see; voxels are its occupied leaves.

Its resolution is one voxel and its origin the middle of the grid: centres of voxels are exact in
the single precision that it counts in. The Python package offers one search a point; its batch
form `getLabels` is a loop around the same search, and half as fast again.
"""

import pyoctomap

from hapticdb.store.base import NO_OCCUPANCY, Keys
from peers import PeerWork
from peers.rows import Found, RowPeer


class OctomapTree(RowPeer):
    """Voxels as leaves of an octree."""

    name = "OctoMap"
    layout = "voxel"

    def load(self, work: PeerWork) -> None:
        self._shift = 0.5 - work.env.grid.side / 2
        self._tree = pyoctomap.OcTree(1.0)
        # inner nodes once, at the end
        self._tree.updateNodes(self.grid.decode(work.voxels) + self._shift, True, True)  # noqa: FBT003 - its own signature: occupied, lazily
        self._tree.updateInnerOccupancy()

    def look_up(self, keys: Keys) -> Found:
        search = self._tree.search
        centers = (self.grid.decode(keys) + self._shift).tolist()
        # only occupied leaves were made: one that is there is occupied
        return keys[[search(center) is not None for center in centers]], NO_OCCUPANCY

    def size(self) -> tuple[str, int]:
        return "memory", int(self._tree.memoryUsage())

    def close(self) -> None:
        del self._tree


PEERS = (OctomapTree,)
