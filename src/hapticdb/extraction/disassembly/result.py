"""Results of a search for an order in which parts come out."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

from hapticdb.extraction.result import Blocker, Extraction, WayOutVerdict, ids_of
from hapticdb.store.base import Object

DisassemblyVerdict = Literal["comes out", "no order found"]


class Removal(NamedTuple):
    """A step: parts that come out while others are gone.

    found : the search with its proved path; excluded : ids of the objects that are not felt in this
    step: the parts themselves, what the caller left out, and what earlier steps took off.
    """

    found: Extraction
    excluded: tuple[int, ...]

    @property
    def ids(self) -> tuple[int, ...]:
        """Ids of what comes out."""
        return ids_of(self.found.parts)


class FailedSearch(NamedTuple):
    """A search that proved no path.

    parts : what was to come out; n_gone : number of steps before it; verdict : of the search, or
    None if the parts cannot be moved at all; blockers : what stops pulls, most pulls first; reason
    : why the parts cannot be moved, else empty.
    """

    parts: tuple[Object, ...]
    n_gone: int
    verdict: WayOutVerdict | None
    blockers: tuple[Blocker, ...]
    reason: str = ""


@dataclass(frozen=True, eq=False)
class Disassembly:
    """Result of a search for an order.

    The order is one in which each step is proved. It may be longer than necessary.

    Attributes
    ----------
    parts : tuple of Object
        What was to come out, as one rigid body.
    steps : tuple of Removal
        In the order in which parts come out. If an order was found, the last step is `parts`. If
        not, the steps are what was taken off in vain.
    failed : tuple of FailedSearch
        Searches that proved no path, in the order in which they were made.
    is_out_of_time : bool
        Whether the time ended the search.
    seconds : float
        Time of all searches with their proofs.
    seed : int
    """

    parts: tuple[Object, ...]
    steps: tuple[Removal, ...]
    failed: tuple[FailedSearch, ...]
    is_out_of_time: bool
    seconds: float
    seed: int

    @property
    def is_found(self) -> bool:
        """Whether the parts come out at the end of the steps."""
        return bool(self.steps) and self.steps[-1].ids == ids_of(self.parts)

    @property
    def verdict(self) -> DisassemblyVerdict:
        """Each step is proved on its whole path; "no order found" proves nothing."""
        return "comes out" if self.is_found else "no order found"

    @property
    def blockers(self) -> tuple[Blocker, ...]:
        """What stopped most pulls of the parts in their last search that failed."""
        for failed in reversed(self.failed):
            if ids_of(failed.parts) == ids_of(self.parts):
                return failed.blockers
        return ()
