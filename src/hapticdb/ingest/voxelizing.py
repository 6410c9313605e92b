"""Voxelization of parts into rows: a part in pieces of bounded size, several parts at once."""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, wait
from contextlib import closing
from functools import partial
from threading import Event
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from hapticdb.cluster.scheduler import Cluster
from hapticdb.errors import FileError
from hapticdb.grid import Grid
from hapticdb.ingest.geometry import packed_surface
from hapticdb.ingest.layout import Bricks, merged, rows_of_bricks
from hapticdb.kernels.surfaces import distances as kernels
from hapticdb.kernels.surfaces import voxelize
from hapticdb.mesh import MeshFile, Part
from hapticdb.mesh.child import bytes_available
from hapticdb.store.base import BRICK_BYTES, Band, Keys, Layout, Object, Rows, Store

Item = TypeVar("Item")
Done = TypeVar("Done")
ShareCallback = Callable[[float], None]
"""Called often with the finished share of a part, 0 to 1; an error from it ends the work."""
SHARE_EVERY_S = 0.2
"""Seconds between two progress reports of a long part. A larger value reports less often."""
BYTES_A_BRICK = 8 + BRICK_BYTES
"""Memory of a brick, bytes: its key and its occupancy."""
_BYTES_A_ROW = 8 + 8 + BRICK_BYTES
"""Memory of a row with distances, bytes, without the packed ones: key, their end, occupancy."""
POINTS_AT_ONCE = 1 << 22
"""Points of a cloud in one kernel call: less than a second of work."""
_VOXELS_SHARE = 0.1
"""Share of the voxels in a part's time if distances are computed, too."""
_MERGE_FROM = 8 * voxelize.MOST_BRICKS
"""Bricks in all pieces at their first merge."""


def rows_of_part(
    part: Part,
    grid: Grid,
    layout: Layout,
    world_from_part: NDArray[np.float64] | None = None,
    progress: ShareCallback | None = None,
    *,
    distances: bool = False,
) -> tuple[Rows, int]:
    """Voxelize a part: its rows, ascending by key, and the number of its voxels.

    A triangle marks every voxel whose closed box it meets; a point marks its voxel.

    world_from_part (4, 4) : placement in metres, the file's unless given; progress : called with
    the finished share of a large part; distances : whether the rows get distances to the part's
    surface, or to the points of a cloud: then there are rows for all bricks near it.

    Raises `FileError` if this would take more memory than the machine has available.
    """
    what = f"part {part.name!r}"
    voxels_alone = _VOXELS_SHARE if distances else 1.0
    if part.is_cloud:
        corners = _on_grid(part.world_points(world_from_part), grid)[:, None]
        pieces = pieces_of_points(corners, grid.bits)
    else:
        corners = _on_grid(part.triangles(world_from_part), grid)
        pieces = voxelize.voxelize_pieces(corners, grid.bits)
    bricks = bricks_of_pieces(pieces, what, _portion(progress, 0.0, voxels_alone))
    if layout == "voxel":
        check_room(8 * voxelize.count_voxels(bricks.occupancy), what)
    if distances:
        measuring = _portion(progress, voxels_alone, 1.0)
        room = partial(check_room, what=what)
        bricks = _with_distances(bricks, corners, grid.bits, room, measuring)
    return rows_of_bricks(bricks, grid, layout)


def _with_distances(
    bricks: Bricks,
    corners: NDArray[np.float64],
    bits: int,
    check_room: Callable[[int], None],
    progress: ShareCallback | None,
) -> Bricks:
    """Bricks near a part, with distances to its surface.

    bricks : those met by the part; corners (T, 3, 3) of triangles, or (P, 1, 3) points of a cloud,
    in voxels from the grid's origin; check_room : called with the least bytes of the result.
    """
    keys: list[Keys] = []
    packed: list[NDArray[np.uint8]] = []
    ends: list[NDArray[np.int64]] = []
    n_rows, n_bytes = 0, 0
    for share, some, data, ends_of_some in kernels.band_pieces(corners, bits):
        keys.append(some)
        packed.append(data)
        ends.append(ends_of_some + n_bytes)
        n_rows, n_bytes = n_rows + len(some), n_bytes + len(data)
        check_room(2 * (_BYTES_A_ROW * n_rows + n_bytes))
        if progress is not None and share < 1.0:
            progress(share)
    if not keys:
        return Bricks(bricks.keys, bricks.occupancy, Band(np.empty(0, np.uint8), bricks.keys[:0]))
    near = np.concatenate(keys)
    occupancy = np.zeros((n_rows, BRICK_BYTES), dtype=np.uint8)
    occupancy[np.searchsorted(near, bricks.keys)] = bricks.occupancy
    return Bricks(near, occupancy, Band(np.concatenate(packed), np.concatenate(ends)))


def _portion(progress: ShareCallback | None, low: float, high: float) -> ShareCallback | None:
    """Callback for a stage of the work, which spans the shares low to high of the whole."""
    if progress is None:
        return None
    return lambda share: progress(low + share * (high - low))


def _on_grid(points: NDArray[np.float64], grid: Grid) -> NDArray[np.float64]:
    """Points (..., 3) in voxels; points that rounding moved over the border are clipped to it."""
    scaled = grid.to_voxel_units(points)
    return np.clip(scaled, 0.0, float(grid.side), out=scaled)


def pieces_of_points(
    points: NDArray[np.float64], bits: int
) -> Iterator[tuple[float, NDArray[np.int64], NDArray[np.uint8]]]:
    """Bricks of the voxels of points, in pieces as of `voxelize.voxelize_pieces`."""
    end = max(len(points), 1)
    for first in range(0, end, POINTS_AT_ONCE):
        some = points[first : first + POINTS_AT_ONCE]
        yield min(1.0, (first + POINTS_AT_ONCE) / end), *voxelize.mark_points(some, bits)


def bricks_of_pieces(
    found: Iterable[tuple[float, NDArray[np.int64], NDArray[np.uint8]]],
    what: str,
    progress: ShareCallback | None = None,
) -> Bricks:
    """Bricks of a part from its pieces: finished share, keys, occupancy.

    Takes the memory of twice the result and one piece; `what` is its name in a `FileError`.
    """
    pieces: list[Bricks] = []
    n_waiting, merge_from = 0, _MERGE_FROM
    for share, keys, occupancy in found:
        pieces.append(Bricks(keys, occupancy))
        n_waiting += len(keys)
        if progress is not None and share < 1.0:
            progress(share)
        if n_waiting > merge_from:
            pieces = [merged(pieces)]
            n_waiting = len(pieces[0].keys)
            merge_from = 2 * n_waiting + _MERGE_FROM
            check_room(2 * BYTES_A_BRICK * n_waiting, what)
    return merged(pieces)


def check_room(n_bytes: int, what: str) -> None:
    """Raise FileError if `n_bytes` exceeds the memory available."""
    left = bytes_available()
    if n_bytes > left:
        raise FileError(
            f"{what}: its rows take more than {n_bytes / 2**30:.1f} GiB of memory, and "
            f"{left / 2**30:.1f} are left; import it into a grid of fewer --bits"
        )


class VoxelizerSettings(NamedTuple):
    """Settings that determine the rows of a part."""

    link: str
    attributes: dict[str, object]
    grid: Grid
    layout: Layout
    distances: bool

    def object_of(
        self, item: tuple[Part, bool], progress: ShareCallback | None = None
    ) -> tuple[Object, Rows, bytes | None]:
        """Object, rows and, if requested, packed surface of a part at its placement in the file."""
        part, is_wanted = item
        try:
            rows, n_voxels = rows_of_part(
                part, self.grid, self.layout, progress=progress, distances=self.distances
            )
            surface = packed_surface(part) if is_wanted else None
        except FileError as error:
            raise FileError(f"{self.link}: {error}") from None
        made = Object(
            name=part.name, link=self.link, digest=part.digest, transform=part.world_from_part,
            voxels=n_voxels, bounds=part.bounds,
            attributes=self.attributes | part.attributes,
        )  # fmt: skip
        return made, rows, surface


def voxelize_parts(
    parts: Iterable[Part], file: MeshFile, store: Store, unit: str | None, jobs: int | Cluster
) -> Generator[tuple[Object, Rows, bytes] | float, None, None]:
    """Yield objects, rows and packed surfaces of parts, in order, a few computed in advance.

    Shares of long parts come between them, as from `in_threads`: the voxelizer releases the
    interpreter lock. unit : of the file, stored with the objects; jobs : threads or workers.
    """
    given = {"unit": unit, "up": file.up}
    attributes: dict[str, object] = {name: value for name, value in given.items() if value}
    recipe = VoxelizerSettings(
        file.link, attributes, store.grid, store.layout, store.wants_distances
    )
    surfaces: dict[str, bytes] = {}
    packed: set[str] = set()

    def items() -> Iterator[tuple[Part, bool]]:
        for part in parts:
            yield part, part.digest not in packed  # instances share a surface
            packed.add(part.digest)

    made: Generator[tuple[Object, Rows, bytes | None] | float, None, None] = (
        in_threads(items(), recipe.object_of, jobs)
        if isinstance(jobs, int)
        else jobs.each(recipe.object_of, items())
    )
    with closing(made):
        for one in made:
            if isinstance(one, float):
                yield one
                continue
            obj, rows, surface = one
            if surface is not None:
                surfaces[obj.digest] = surface
            yield obj, rows, surfaces[obj.digest]


def in_threads(
    items: Iterable[Item], work: Callable[[Item, ShareCallback], Done], jobs: int
) -> Generator[Done | float, None, None]:
    """Yield the results of `work` on items, in order; `jobs` threads compute a few in advance.

    While the next result is pending, its finished share, 0 to 1, is yielded five times a second.
    `work` gets an item and a callback for its share; the callback raises an error after the end of
    this generator.
    """
    shares: dict[int, float] = {}
    ended = Event()

    def note_share(number: int, share: float) -> None:
        if ended.is_set():
            raise CancelledError
        shares[number] = share

    def worked(number: int, item: Item) -> Done:
        return work(item, partial(note_share, number))

    waiting: deque[tuple[int, Future[Done]]] = deque()

    def next_result() -> Iterator[Done | float]:
        number, future = waiting.popleft()
        while not wait([future], SHARE_EVERY_S).done:
            yield shares.get(number, 0.0)
        shares.pop(number, None)
        yield future.result()

    pool = ThreadPoolExecutor(jobs, thread_name_prefix="voxelize")
    try:
        for number, item in enumerate(items):
            waiting.append((number, pool.submit(worked, number, item)))
            if len(waiting) > 2 * jobs:
                yield from next_result()
        while waiting:
            yield from next_result()
    finally:
        ended.set()
        pool.shutdown(wait=True, cancel_futures=True)
