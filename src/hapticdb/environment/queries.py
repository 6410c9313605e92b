"""Queries of an opened environment for a tool, at one pose or at many."""

import os
from collections.abc import Generator, Iterator
from functools import partial
from typing import TYPE_CHECKING, cast, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.errors import UsageError
from hapticdb.paper.figures import QueryFigures
from hapticdb.paper.grouping import DEFAULT_MAXGAP
from hapticdb.paper.strategies import Strategies, Strategy
from hapticdb.pointshell.shell import PointShell
from hapticdb.query.haptic_query import as_poses
from hapticdb.query.law import PLANE, ForceLaw, LawName, as_law, inset_of
from hapticdb.query.touches import Touch
from hapticdb.store.base import Store
from hapticdb.store.filtering import ALL, NOTHING, Filter, FiltersOfWords
from hapticdb.store.finding import Words, find_objects

if TYPE_CHECKING:
    from hapticdb.batches.batch_results import ClearanceBatch, TouchBatch
    from hapticdb.batches.batch_tool import BatchDevice, BatchTool, PoseCallback
    from hapticdb.batches.exact import Distance

FilePath = str | os.PathLike[str]


class Queries:
    """Haptic queries, a base of `hapticdb.environment.Environment`."""

    def __init__(self, store: Store, figures: QueryFigures, address: str) -> None:
        self._store = store
        self.address = address
        """URL for another process: as given, or an absolute path."""
        self._strategies = Strategies(store, figures.both)
        self._query = self._strategies.query
        self._filters = FiltersOfWords()

    @property
    def has_distances(self) -> bool:
        """Whether there is an object, and every object has distances to its surface.

        As of the revision that was read last. Costs a statement only before the first frame and
        after an edit of this environment.
        """
        if self._query.known.version is None:
            self._query.known.newest()
        return self._query.known.have_distances

    def tool(
        self,
        file: FilePath,
        points: int | None = None,
        *,
        spacing: float | None = None,
        unit: str | None = None,
        seed: int = 0,
        inset: float | None = None,
    ) -> PointShell:
        """Make a tool of a file as the verbs and the page do.

        file, points, spacing, unit, seed : as for `PointShell.from_file`
        inset : how far points are drawn inward, metres. Unless given, so far that contact begins at
            the tool's surface: 1.5 voxels where objects have distances, for the distance law.
        """
        drawn = self._inset if inset is None else inset
        return PointShell.from_file(
            file, points, spacing=spacing, unit=unit, seed=seed, inset=drawn
        )

    def _tool_of(self, file: object) -> PointShell:
        if not isinstance(file, str | os.PathLike):
            raise UsageError("give a tool, then one pose, or many as poses=...")
        return self.tool(file)

    @property
    def _inset(self) -> float:
        return inset_of(self._store.grid.voxel_size, "distance" if self.has_distances else "plane")

    @overload
    def touch(
        self,
        shell: PointShell | FilePath,
        pose: ArrayLike,
        strategy: Strategy = "auto",
        *,
        where: Words = NOTHING,
        exclude: Words = NOTHING,
        maxgap: int = DEFAULT_MAXGAP,
        law: ForceLaw | LawName | None = None,
    ) -> Touch: ...

    @overload
    def touch(
        self,
        shell: PointShell | FilePath,
        *,
        poses: ArrayLike,
        where: Words = NOTHING,
        exclude: Words = NOTHING,
        law: ForceLaw | LawName | None = None,
        objects: bool = False,
        device: "BatchDevice" = "cpu",
        progress: "PoseCallback | None" = None,
    ) -> "TouchBatch": ...

    def touch(
        self,
        shell: PointShell | FilePath,
        pose: ArrayLike | None = None,
        strategy: Strategy = "auto",
        *,
        poses: ArrayLike | None = None,
        where: Words = NOTHING,
        exclude: Words = NOTHING,
        maxgap: int = DEFAULT_MAXGAP,
        law: ForceLaw | LawName | None = None,
        objects: bool = False,
        device: "BatchDevice" = "cpu",
        progress: "PoseCallback | None" = None,
    ) -> "Touch | TouchBatch":
        """Force and torque of the environment on the tool, at one pose or at many.

        Points outside the grid miss. All statements of a touch read one committed revision.

        shell : points in metres and inward unit normals, tool frame; or a file, as for `tool`
        pose (4, 4) : world_from_tool, rigid, metres; returns a `Touch`
        poses (B, 4, 4) : many of them instead, for a `TouchBatch`, the same bit for bit, by all
            processors
        objects, progress, device : for many poses, as for `BatchTool.touch` and `batch_tool`
        strategy : for one pose, form of the query: ``statement``, ``array``, ``points``,
            ``maxgap``, ``cbgroup``, which all read the database, or ``auto``: decoded bricks stay
            in memory, and missing ones are read as by ``array``, or many as by ``cbgroup``. All
            strategies find the same hits, ids and wrench, bit for bit.
        where, exclude : filter of the contacts: objects of `where`, all if it is empty, less those
            of `exclude`: a part that is moved must not collide with itself. Ids, names, patterns
            and ``attribute=value``, as for `find`; evaluated again after other writers' commits.
        maxgap : for the strategy ``maxgap``: greatest distance, in keys, of neighbours in one range
        law : by default ``distance`` (`DistanceField`) where `has_distances`, else ``plane``, with
            1000 N/m. The strategy ``statement`` computes ``plane`` alone.

        Raises `UsageError` for a pose that is not rigid, an unknown strategy, or objects without
        the law's input; `ObjectNotFoundError` for a word of `where` or `exclude` without a match.
        """
        if (pose is None) == (poses is None):
            raise UsageError("touch: give either one pose, or poses=...")
        if not isinstance(shell, PointShell):  # first: a test for paths takes a microsecond
            shell = self._tool_of(shell)
        if getattr(pose, "ndim", 2) == 3:
            raise UsageError("give a tool, then one pose, or many as poses=...")
        if pose is not None:
            selection = ALL if where is exclude is NOTHING else self._filters.of(where, exclude)
            chosen = as_law(law) if isinstance(law, str) else law
            return self._strategies.touch(shell, pose, strategy, maxgap, selection, chosen)
        if strategy != "auto":
            raise UsageError(f"strategy {strategy!r} for many poses: leave it out")
        with self.batch_tool(
            shell, where=where, exclude=exclude, law=law, device=device
        ) as batch_tool:
            return batch_tool.touch(poses, objects=objects, progress=progress)  # type: ignore[arg-type]

    def touch_pieces(
        self,
        shell: PointShell,
        poses: NDArray[np.float64],
        *,
        where: Words = (),
        exclude: Words = (),
        law: ForceLaw | LawName | None = None,
        on: str = "cpu",
    ) -> Generator["TouchBatch", None, None]:
        """Touch at more poses than fit into memory, in batches, in their order.

        poses (B, 4, 4) : may be mapped from a file
        shell, where, exclude, law : as for `touch`
        on : ``cpu``, ``cuda``, or a scheduler of dask.distributed, ``tcp://host:8786``. Its workers
            reach the environment by the URL that opened it. Results are the same, bit for bit.
        """
        from hapticdb.batches import batch_tool as batch_tools  # noqa: PLC0415 - loads numba
        from hapticdb.cluster.environment_address import EnvironmentAddress  # noqa: PLC0415
        from hapticdb.cluster.scheduler import connected  # noqa: PLC0415

        def pieces(size: int) -> Iterator[NDArray[np.float64]]:
            return (np.asarray(poses[at : at + size]) for at in range(0, len(poses), size))

        if "://" not in on:
            device = cast("BatchDevice", on)
            with self.batch_tool(
                shell, where=where, exclude=exclude, law=law, device=device
            ) as batch_tool:
                yield from map(batch_tool.touch, pieces(batch_tools.PIECE))
            return
        selection, chosen = self._filters.of(where, exclude), self._query.law_now(as_law(law))
        with connected(on) as workers:
            assert workers is not None  # noqa: S101 - there is an address
            work = partial(
                batch_tools.touch_at,
                EnvironmentAddress.of(self._store, self.address),
                shell,
                selection,
                chosen,
            )
            yield from workers.each(work, pieces(batch_tools.TASK))

    def collides(
        self,
        shell: PointShell | FilePath,
        poses: ArrayLike,
        *,
        where: Words = (),
        exclude: Words = (),
        exact: bool = False,
        device: "BatchDevice" = "cpu",
        progress: "PoseCallback | None" = None,
    ) -> NDArray[np.bool_]:
        """Whether the tool collides at rigid poses (B, 4, 4): `touch` has hits there.

        By the shell's points, which may miss what is thinner than they are apart. With `exact`
        whether its surface meets that of an object, as for `clearance`.

        Arguments as for `touch`, `batch_tool` and `BatchTool.touch`; errors as for `touch`.
        """
        if exact:
            from hapticdb.batches.exact import MET  # noqa: PLC0415 - loads kernels

            return ~self.clearance(
                shell, poses, MET, where=where, exclude=exclude, exact=True, device=device,
                progress=progress,
            ).is_beyond  # fmt: skip
        if not isinstance(shell, PointShell):
            shell = self._tool_of(shell)
        with self.batch_tool(
            shell, where=where, exclude=exclude, law=PLANE, device=device
        ) as batch_tool:
            return batch_tool.collides(poses, progress=progress)

    def clearance(
        self,
        shell: PointShell | FilePath,
        poses: ArrayLike,
        reach: float | None = None,
        *,
        where: Words = (),
        exclude: Words = (),
        exact: bool = False,
        device: "BatchDevice" = "cpu",
        progress: "PoseCallback | None" = None,
    ) -> "ClearanceBatch":
        """Distance from the shell's points to the nearest occupied voxel at many poses.

        By points and voxels: never more than the distance of the surfaces. With `exact`, the
        distance between the surfaces of the tool and the nearest object, with the index of the
        shell's point nearest to it; some hundred times slower, on processors alone.

        poses (B, 4, 4) : world_from_tool, rigid, metres, in any order
        reach : greatest distance searched, metres; unless given 32 voxels, or no limit with
            `exact`. Distances beyond it are infinite.

        Raises `UsageError` for a pose that is not rigid, a reach that is not positive, or one too
        large for the memory; `ObjectNotFoundError` as for `touch`.
        """
        if not isinstance(shell, PointShell):
            shell = self._tool_of(shell)
        if exact:
            from hapticdb.batches.batch_tool import reach_of  # noqa: PLC0415 - likewise
            from hapticdb.batches.exact import exact_clearance  # noqa: PLC0415 - loads kernels

            if device != "cpu":
                raise UsageError(f"device {device!r}: exact distances are computed on processors")
            limit = np.inf if reach is None else reach_of(reach, 1.0)
            with self._store.snapshot():
                selection = Filter(where, exclude).select(self._store.objects(), self._store.url)
                return exact_clearance(
                    self._store, selection, shell, as_poses(poses), limit, progress
                )
        with self.batch_tool(
            shell, where=where, exclude=exclude, law=PLANE, device=device
        ) as batch_tool:
            return batch_tool.clearance(poses, reach, progress=progress)

    def distance(self, a: int | str, b: int | str) -> "Distance":
        """Least distance of the surfaces of two objects, with the nearest places.

        a, b : as for `find`; of several objects the two nearest are measured. How deep two overlap,
        and whether one lies in the other, `hapticdb.find_clashes` says.
        """
        from hapticdb.batches.exact import least_distance  # noqa: PLC0415 - loads kernels

        with self._store.snapshot():
            ones, others = (find_objects(self._store, [word]) for word in (a, b))
            return least_distance(self._store, ones, others)

    def batch_tool(
        self,
        shell: PointShell,
        *,
        where: Words = (),
        exclude: Words = (),
        law: ForceLaw | LawName | None = None,
        budget_bytes: int | None = None,
        jobs: int | None = None,
        device: "BatchDevice" = "cpu",
    ) -> "BatchTool":
        """Make a tool with cells resident in memory from one batch of poses to the next.

        shell, where, exclude, law : as for `touch`; the law is chosen for the present objects
        budget_bytes : memory for cells, never exceeded; 256 MiB unless given
        jobs : threads; one for each processor unless given
        device : the processors, or an NVIDIA GPU with the extra ``gpu`` and its memory

        Raises `MissingExtraError` without a GPU for numba; `UsageError` in lexicographic order,
        which has no cells, for a budget too small or above this machine's memory, or for objects
        without the law's input.
        """
        from hapticdb.batches.batch_tool import BatchTool  # noqa: PLC0415 - loads numba

        selection = self._filters.of(where, exclude)
        chosen = self._query.law_now(as_law(law))
        return BatchTool(self._query, shell, selection, chosen, budget_bytes, jobs, device)
