"""Tests of kept pairs: what was found about two objects, beside the objects."""

import pytest

from hapticdb.errors import ReadOnlyError
from hapticdb.store.base import Store
from hapticdb.store.pairs import Mark, PairRow
from hapticdb.testing.case import StoreCase

PLACE = (0.1, -0.2, 1 / 3, 0.1, -0.2, 0.5)
FIRST = PairRow(1, 2, "apart", 0.1, 0.1 + 2**-50, PLACE, "new", 2, "a setting")
SECOND = PairRow(1, 3, "overlapping", 1e-3, None, PLACE, "new", 2, "a setting")


class PairsContract(StoreCase):
    """Rows of pairs return bit for bit; a later revision's row is not written over."""

    def test_rows_come_back_in_order(self, store: Store) -> None:
        """All values return as they were, and no revision is made."""
        revision = store.revision()
        assert list(store.pairs()) == []
        store.put_pairs([SECOND, FIRST])
        assert list(store.pairs()) == [FIRST, SECOND]
        changed = SECOND._replace(kind="touching", at_most=0.0, status="changed", revision=3)
        store.put_pairs([changed], [(1, 2), (7, 8)])
        assert list(store.pairs()) == [changed]
        store.put_pairs([], [(1, 3)])
        assert list(store.pairs()) == []
        assert store.revision() == revision

    def test_a_later_revision_stays(self, store: Store) -> None:
        """Of two that look at once, the one that has read the newer objects is right."""
        store.put_pairs([FIRST])
        store.put_pairs([FIRST._replace(kind="touching", revision=1)])
        assert list(store.pairs()) == [FIRST]

    def test_the_mark_is_that_of_who_wrote_last(self, store: Store) -> None:
        """Who has read the mark learns whether another has written since; it is no row."""
        assert store.pairs().mark == Mark()
        mine = store.put_pairs([FIRST], was=Mark())
        assert mine is not None
        assert store.pairs().mark == mine
        assert store.put_pairs([SECOND], [(7, 8)], Mark(), Mark("a setting", 9)) is None
        theirs = store.pairs().mark
        assert theirs not in {mine, Mark(), Mark("a setting", 9)}
        assert store.put_pairs([], was=theirs, now=Mark("a setting", 9)) == Mark("a setting", 9)
        assert store.put_pairs([], was=Mark("a setting", 9), now=Mark("another", 2)) is not None
        assert store.pairs().mark == Mark("another", 2)
        store.accept_pair(1, 2, "a press fit", "ball cone")
        kept = store.pairs()
        assert kept.mark == Mark("another", 2)
        assert [row[:2] for row in kept] == [(1, 2), (1, 3)]
        assert [[row[:2] for row in part] for part in kept.parted({3})] == [[(1, 3)], [(1, 2)]]

    def test_an_acceptance_outlasts_a_new_measurement(self, store: Store) -> None:
        """A pair without a row cannot be accepted."""
        store.put_pairs([FIRST])
        store.accept_pair(1, 2, "a press fit", "ball cone")
        store.accept_pair(4, 5, "nothing", "at all")
        store.put_pairs([FIRST._replace(at_least=0.2)])
        accepted = FIRST._replace(at_least=0.2, because="a press fit", shapes="ball cone")
        assert list(store.pairs()) == [accepted]
        store.accept_pair(1, 2, None, None)
        assert list(store.pairs()) == [FIRST._replace(at_least=0.2)]

    def test_a_reader_sees_pairs_and_writes_none(self, store: Store) -> None:
        """A snapshot keeps what it sees."""
        store.put_pairs([FIRST])
        reader = self.reopen(store)
        with reader.snapshot():
            assert list(reader.pairs()) == [FIRST]
            store.put_pairs([SECOND])
            assert list(reader.pairs()) == [FIRST]
        assert list(reader.pairs()) == [FIRST, SECOND]
        if reader.is_read_only:
            with pytest.raises(ReadOnlyError):
                reader.put_pairs([FIRST])
        reader.close()
