"""The body of `coupling` for large tools, whose clusters of points sleep far from everything.

It is an entry of its own, so that sessions with small tools need not compile it.
"""

from hapticdb.kernels._jit import FLOAT, INT, INTS, INTS2, entry, record_of
from hapticdb.kernels.hand.body import BODY
from hapticdb.kernels.hand.coupling import move_body
from hapticdb.kernels.large.budget import Asleep
from hapticdb.kernels.large.sleeping import LEFT_OUT, SLEEPERS
from hapticdb.kernels.records import SERVO
from hapticdb.kernels.resident.cells import CELLS, CLUSTERS, PLACE


@entry(
    CELLS, INT, CLUSTERS, PLACE, BODY, record_of(SERVO), FLOAT, INTS2, INTS, SLEEPERS, INT, INTS2
)
def advance_asleep(
    cells, reader, shell, place, body, servo_record, dt, met, missed, sleepers, budget, counts
):
    """`advance` of a large tool with sleeping clusters, at most `budget` points a frame.

    counts (1, COUNTS) int64 takes the greatest numbers of the period's frames;
    `sent.left_out` is the number of points that the budget left out.
    """
    for n in range(counts.shape[1]):
        counts[0, n] = 0
    watch = Asleep(sleepers, budget, counts)
    move_body(watch, cells, reader, shell, place, body, servo_record, dt, met, missed)
    servo_record[()].sent.left_out = counts[0, LEFT_OUT]
