"""The hand that `feel --device` names."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from hapticdb.errors import UsageError

if TYPE_CHECKING:
    from hapticdb.cli.values import Point
    from hapticdb.devices.profiles import DeviceProfile
    from hapticdb.devices.protocol import Device

VENDORS = {
    "force-dimension": ("hapticdb.devices.vendors.force_dimension", "ForceDimensionDevice"),
    "openhaptics": ("hapticdb.devices.vendors.openhaptics", "OpenHapticsDevice"),
    "haply": ("hapticdb.devices.vendors.haply", "HaplyDevice"),
}
"""Module and class of each device that can be bought, by its word."""
RANDOM_SPEED = 0.3
"""Greatest speed of a random hand unless --speed is given, m/s."""


@dataclass(frozen=True)
class HandOptions:
    """What the options of `feel` say of the hand.

    word : --device; speed : m/s; place : --at; loops : a path begins again at its end;
    is_simulated : the force moves the hand; profile : what the device renders.
    """

    word: str
    speed: float | None
    place: "Point | None"
    seed: int
    loops: bool
    is_simulated: bool
    profile: "DeviceProfile | None" = None

    def open(self) -> "tuple[Device, float | None]":
        """Open the device, or read the motion; also the speed assumed for a path without times."""
        self._check()
        if self.word in VENDORS:
            return self._vendor_device(), None
        hand = self._scripted()
        assumed = getattr(hand, "assumed_speed", None)
        return self._simulated(hand) if self.is_simulated else hand, assumed

    def _ends_with(self, suffix: str) -> bool:
        return self.word.lower().endswith(suffix)

    def _check(self) -> None:
        """Refuse options that the hand does not take."""
        word = self.word
        if self.seed < 0:
            raise UsageError(f"--seed {self.seed}: give 0 or more")
        if word == "random" and self.place is None:
            raise UsageError("--device random: give --at, where the hand is")
        if word != "random" and self.place is not None:
            raise UsageError(f"--at belongs to random, not to {word}")
        if self.loops and word == "random":
            raise UsageError("--loop: --device random has no end; leave it out")
        if self.speed is not None and self._ends_with(".hdbrec"):
            raise UsageError(f"--speed: --device {word} has its own; leave it out")
        if word in VENDORS and (self.is_simulated or self.loops or self.speed is not None):
            raise UsageError(
                f"--device {word} is a real hand: leave out --simulate, --loop, --speed"
            )

    def _vendor_device(self) -> "Device":
        from importlib import import_module

        module, name = VENDORS[self.word]
        given = {} if self.profile is None else {"profile": self.profile}
        device: Device = getattr(import_module(module), name)(**given)
        return device

    def _simulated(self, hand: "Device") -> "Device":
        """Device that a hand holds, with cap and mass of the profile."""
        from hapticdb.devices.simulated import SimulatedDevice

        if self.profile is None:
            return SimulatedDevice(hand)
        if self.profile.mass is None:
            return SimulatedDevice(hand, max_force=self.profile.cap)
        return SimulatedDevice(hand, max_force=self.profile.cap, mass=self.profile.mass)

    def _scripted(self) -> "Device":
        """The hand that a motion moves."""
        from hapticdb.devices import scripted
        from hapticdb.recording.file import Recording

        if self.word == "random":
            greatest = RANDOM_SPEED if self.speed is None else self.speed
            assert self.place is not None  # noqa: S101 - checked before
            return scripted.RandomHand(self.place, self.seed, greatest)
        if self._ends_with(".hdbrec"):
            times, poses = Recording(self.word).poses()
            return scripted.Player(times, poses, loops=self.loops)
        if self._ends_with(".csv"):
            return scripted.Path(self.word, speed=self.speed, loops=self.loops)
        raise UsageError(
            f"--device {self.word!r}: give poses in a .csv, a .hdbrec, random, {', '.join(VENDORS)}"
        )
