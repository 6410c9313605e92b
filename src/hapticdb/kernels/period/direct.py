"""The loop of sessions that are rendered directly: compiled apart, since few need both."""

from hapticdb.kernels._jit import entry, record_of
from hapticdb.kernels.law import TANGENT_PLANE
from hapticdb.kernels.period.loop import run_periods
from hapticdb.kernels.records import FRAME, PACE, SEAT, STATION


@entry(
    record_of(STATION, 1), record_of(SEAT, 1), record_of(FRAME, 2), record_of(PACE), TANGENT_PLANE
)
def run_directly(stations, seats, rings, pace_record, law):
    """`run_periods` of sessions under a law that reads no distances."""
    run_periods(stations, seats, rings, pace_record, law)
