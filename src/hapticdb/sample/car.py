"""The sample's car: about two hundred parts, 4.2 m long, z up, on the plane z = 0."""

from hapticdb.sample.ancillaries import add_ancillaries
from hapticdb.sample.body import add_body
from hapticdb.sample.cabin import add_cabin
from hapticdb.sample.chassis import add_chassis
from hapticdb.sample.drivetrain import add_drivetrain
from hapticdb.sample.engine import add_engine
from hapticdb.sample.parts import Assembly, SamplePart
from hapticdb.sample.supply import add_supplies
from hapticdb.sample.wheels import add_spare, add_wheels


def build_car() -> list[SamplePart]:
    """Every part of the car, always the same and in the same order.

    World frame: metres, x forward, y left, z up; the origin on the ground between the wheels.
    """
    car = Assembly()
    add_body(car)
    add_wheels(car)
    add_spare(car)
    add_chassis(car)
    add_engine(car)
    add_ancillaries(car)
    add_drivetrain(car)
    add_supplies(car)
    add_cabin(car)
    return car.parts
