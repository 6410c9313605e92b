"""The strategy `auto`: what the cost model expects, corrected by what recent frames took."""

from typing import Literal, NamedTuple

from hapticdb.query.cost_model import CostModel
from hapticdb.query.grouping import Grouping, cbgroup
from hapticdb.query.quantiles import QuantileVector
from hapticdb.store.base import Keys

Chosen = Literal["array", "cbgroup", "points", "statement"]

LOOK_US = 60.0
"""What choosing takes: its code is seldom run and never warm, least beside a server's."""
LOOK_SHARE = 0.01
"""Share of the frames' time that may be spent on choosing."""
LEAST_KEPT, MOST_KEPT = 4, 64
"""Frames of a turn, whatever that comes to."""
TRY_EVERY = 128
"""Frames between two that ask in another way than the best, to hear what it takes now."""
WORTH_TRYING = 2.0
"""Times the least cost up to which a strategy is tried: no model is wrong by more."""
STILL_WORTH_TRYING = 1.75
"""The same for one whose cost is known from frames of its own."""
LONG = 2048
"""Frames after which what is known of a strategy is doubted."""
DOUBTED = 4.0
"""Times the least cost up to which it is then as if it had never been heard of."""
FEW = 4
"""Frames heard of after which a strategy's cost is known."""
PACE = 0.2
"""Share of one frame's time in a correction: what disturbs one frame is soon forgotten."""
ROWS_PACE = 0.05
"""The same for rows, which differ much from frame to frame, and with every part that is left."""
SAME_SHELL = 0.25
"""Relative change of the number of keys up to which a choice made for one frame serves the next."""
MOST_OFF = 16.0
"""Times by which rows may differ from what is expected; where none are, none says nothing."""


class Choice(NamedTuple):
    """How a frame may ask: keys and ranges that it names, rows that the quantile vector expects."""

    strategy: Chosen
    points: int
    keys: int
    ranges: int
    rows: float


class Chooser:
    """Chooses for one opened environment and one size of shell, and learns.

    The model's figures hold for pages that are cached, and rows are expected by a histogram, which
    knows nothing of the place: a tool that lifts off finds none where it found a hundred. So frames
    correct, by strategy, how many rows come and how long they take, and one turn in a while is
    another strategy's.

    A turn begins with a frame for which `choose` weighs all strategies, and whose rows it is told
    (`find`); frames follow that `kept` gives the same strategy; the last of them, which runs as all
    others of its strategy do, is timed (`hear`).
    """

    def __init__(self, quantiles: QuantileVector, costs: CostModel) -> None:
        self.quantiles = quantiles
        self.costs = costs
        self._slowness: dict[Chosen, float] = {}
        self._crowding: dict[Chosen, float] = {}
        self._heard: dict[Chosen, int] = {}
        self._tried: dict[Chosen, int] = {}
        self._frame = 0
        self._turn: Chosen = "cbgroup"
        self._left = 0
        self._fewest = self._most = 0.0

    def kept(self, n_keys: int) -> Chosen | None:
        """Strategy of the present turn, while it serves a frame of so many keys.

        Choosing anew would take as long as a fast frame; this takes less than a microsecond.
        """
        if self._left <= 0 or not self._fewest <= n_keys <= self._most:
            return None
        self._left -= 1
        self._frame += 1
        return self._turn

    @property
    def is_listening(self) -> bool:
        """Whether the frame that was just given its strategy is the last of its turn."""
        return self._left == 0

    def choose(self, n_points: int, keys: Keys) -> Choice:
        """Begin a turn: the strategy of least expected cost for a frame of these keys (U,)."""
        self._frame += 1
        n_keys = len(keys)
        choices = self._choices(n_points, n_keys, cbgroup(keys, self.quantiles, self.costs))
        cost = {name: self._cost(choice) for name, choice in choices.items()}
        best = min(cost, key=cost.__getitem__)
        self._turn = self._worth_trying(best, cost) or best
        is_known = self._heard.get(best, 0) >= FEW
        worth = int(min(max(LOOK_US / (LOOK_SHARE * max(cost[best], 1)), LEAST_KEPT), MOST_KEPT))
        self._left = worth if is_known and self._turn == best else 1
        self._fewest, self._most = (1 - SAME_SHELL) * n_keys, (1 + SAME_SHELL) * n_keys
        return choices[self._turn]

    def find(self, choice: Choice, rows: int) -> None:
        """Take in how many rows the first frame of a turn has read."""
        off = min(max((rows + 1) / (choice.rows + 1), 1 / MOST_OFF), MOST_OFF)
        before = self._crowding.get(choice.strategy, off)
        self._crowding[choice.strategy] = before + ROWS_PACE * (off - before)

    def hear(self, choice: Choice, took_us: float) -> None:
        """Take in how long a frame took, from its keys to its wrench; its rows are what it read."""
        name = choice.strategy
        heard = self._heard.get(name, 0)
        modelled = self._model(choice)
        if modelled <= 0.0:  # nothing was asked, or nothing is known of what that costs
            return
        slowness = took_us / modelled
        before = self._slowness[name] if heard else slowness
        if heard < FEW:  # whatever disturbs a frame makes it longer
            slowness = min(slowness, before)
        else:  # one that waited for something else is not believed
            slowness = before + PACE * (min(max(slowness, before / 2), before * 2) - before)
        self._slowness[name] = slowness
        self._heard[name] = heard + 1

    def _choices(self, n_points: int, n_keys: int, grouping: Grouping) -> dict[Chosen, Choice]:
        rows = grouping.rows_asked * self.costs.presence
        scanned = rows + grouping.rows_in_gaps * self.costs.crowding
        n_ranges = len(grouping.ranges.lows)
        return {
            "array": Choice("array", n_points, n_keys, n_keys, rows),
            "cbgroup": Choice("cbgroup", n_points, n_keys, n_ranges, scanned),
            "points": Choice("points", n_points, n_keys, n_keys, rows),
            "statement": Choice("statement", n_points, n_keys, n_points, rows),
        }

    def _model(self, choice: Choice) -> float:
        """What the model says of a choice; grouping is paid for by who needs it."""
        costs = self.costs
        if choice.strategy == "array":
            return costs.of_keys(choice.keys, choice.rows)
        if choice.strategy == "cbgroup":
            return costs.of_ranges(choice.ranges, choice.rows) + costs.of_grouping(choice.keys)
        if choice.strategy == "points":
            return costs.of_points(choice.keys)
        return costs.of_statement(choice.points)

    def _cost(self, choice: Choice) -> float:
        """What a choice should take here and now."""
        name = choice.strategy
        rows = (choice.rows + 1) * self._crowding.get(name, 1.0) - 1
        # of one hardly tried it is believed that it suffers from the same as the present one
        slowness = self._slowness.get(self._turn, 1.0)
        if self._heard.get(name, 0) >= FEW:
            slowness = self._slowness[name]
        return self._model(choice._replace(rows=max(rows, 0.0))) * slowness

    def _worth_trying(self, best: Chosen, cost: dict[Chosen, float]) -> Chosen | None:
        """Another strategy than the best, when it is its turn."""
        if best not in self._heard:
            return None
        for name, us in cost.items():
            if name == best:
                continue
            since = self._frame - self._tried.get(name, 0)
            if since >= LONG and us <= DOUBTED * cost[best]:
                self._heard[name] = 0
            is_known = self._heard.get(name, 0) >= FEW
            worth = STILL_WORTH_TRYING if is_known else WORTH_TRYING
            if us <= worth * cost[best] and (not is_known or since >= TRY_EVERY):
                self._tried[name] = self._frame
                return name
        return None
