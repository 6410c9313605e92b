"""Devices and scripted hands of `feel --device`."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from hapticdb.cli.values import Point, refuse
from hapticdb.errors import UsageError

if TYPE_CHECKING:
    from hapticdb.devices.profiles import DeviceProfile
    from hapticdb.devices.protocol import Device

VENDORS = {
    "force-dimension": ("hapticdb.devices.vendors.force_dimension", "ForceDimensionDevice"),
    "openhaptics": ("hapticdb.devices.vendors.openhaptics", "OpenHapticsDevice"),
    "haply": ("hapticdb.devices.vendors.haply", "HaplyDevice"),
}
"""Module and class of each commercial device, by its word."""


@dataclass(frozen=True)
class HandOptions:
    """Options of the device or scripted hand, and of the mapping of its motion to the tool."""

    device: str
    speed: float | None = None
    at: Point | None = None
    simulate: bool = False
    loop: bool = False
    scale: float = 1.0
    clutch: int | None = None

    def open(self, seed: int, profile: "DeviceProfile | None") -> "tuple[Device, float | None]":
        """Device, or hand on a motion; also the assumed speed of a path without times, m/s."""
        self._check(seed)
        if self.device in VENDORS:
            return self._vendor_device(profile), None
        hand = self._scripted(seed)
        assumed = getattr(hand, "assumed_speed", None)
        return _simulated(hand, profile) if self.simulate else hand, assumed

    def _check(self, seed: int) -> None:
        """UsageError for options without meaning for the hand."""
        word = self.device
        if seed < 0:
            raise UsageError(f"--seed {seed}: give 0 or more")
        if word == "random" and self.at is None:
            raise UsageError("--device random: give --at, where the hand is")
        unused = "loop" if word == "random" else "at"
        unused += " simulate loop speed" if word in VENDORS else ""
        unused += " speed" if word.lower().endswith(".hdbrec") else ""
        refuse(f"with --device {word}", self, unused)

    def _vendor_device(self, profile: "DeviceProfile | None") -> "Device":
        from importlib import import_module

        module, name = VENDORS[self.device]
        given = {} if profile is None else {"profile": profile}
        device: Device = getattr(import_module(module), name)(**given)
        return device

    def _scripted(self, seed: int) -> "Device":
        """Hand on a random motion, a recorded one, or a path of poses."""
        from hapticdb.devices import scripted
        from hapticdb.recording.file import Recording

        if self.at is not None:
            return scripted.RandomHand(self.at, seed, 0.3 if self.speed is None else self.speed)
        word = self.device.lower()
        if word.endswith(".hdbrec"):
            times, poses = Recording(self.device).poses()
            return scripted.Player(times, poses, loops=self.loop)
        if word.endswith(".csv"):
            return scripted.Path(self.device, speed=self.speed, loops=self.loop)
        raise UsageError(
            f"--device {self.device!r}: give poses in a .csv, a .hdbrec, random, "
            f"{', '.join(VENDORS)}"
        )


def _simulated(hand: "Device", profile: "DeviceProfile | None") -> "Device":
    """Simulated device driven by a hand, with cap and mass of the profile."""
    from hapticdb.devices.simulated import SimulatedDevice

    if profile is None:
        return SimulatedDevice(hand)
    if profile.mass is None:
        return SimulatedDevice(hand, max_force=profile.cap)
    return SimulatedDevice(hand, max_force=profile.cap, mass=profile.mass)
