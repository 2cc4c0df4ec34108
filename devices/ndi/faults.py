"""Faults of an emulated line, on demand and seeded: what a cable, a network or a sick tracker does to replies."""

from __future__ import annotations

import random
from dataclasses import dataclass, field

from devices.errors import DeviceInputError

__all__ = ["Delivery", "Faults"]

_SHARES = ("cut", "late", "corrupt", "duplicate")
_DEFAULT_SHARE = 0.05
_DEFAULT_SILENCE_S = 2.0
_DEFAULT_PERIOD = 300


@dataclass
class Delivery:
    """What becomes of one reply.

    Parameters
    ----------
    data : bytes
        What goes out.
    delay_s : float
        After which wait.
    disconnect : bool
        Whether the line is cut instead.
    """

    data: bytes
    delay_s: float = 0.0
    disconnect: bool = False


@dataclass
class Faults:
    """Which faults happen to the replies of an emulator.

    Parameters
    ----------
    cut, late, corrupt, duplicate : float
        Shares of replies of which only the first part is sent, that come `late_s` later, that have bytes changed, that
        are sent twice.
    late_s : float
    silence_s : float
        At every `period`-th tracking reply the device falls silent for so long; 0: never.
    disconnect, out_of_volume : bool
        At every `period`-th tracking reply the line is cut; the first body leaves the volume, and returns at the next.
    period : int
    seed : int
    """

    cut: float = 0.0
    late: float = 0.0
    corrupt: float = 0.0
    duplicate: float = 0.0
    late_s: float = 0.2
    silence_s: float = 0.0
    disconnect: bool = False
    out_of_volume: bool = False
    wrap: bool = False
    period: int = _DEFAULT_PERIOD
    seed: int = 0
    #: how often each fault has happened
    happened: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)
        self._tracking_replies = 0
        self._once: list[str] = []
        if self.period < 1 or any(not 0.0 <= getattr(self, name) <= 1.0 for name in _SHARES):
            raise DeviceInputError("faults: shares lie in [0, 1], the period is at least 1")

    @classmethod
    def parse(cls, specifications: list[str], seed: int = 0) -> Faults:
        """Read ``NAME`` or ``NAME=VALUE``, one fault each.

        cut, late, corrupt, duplicate: VALUE is the share of replies; silence: seconds; disconnect, out-of-volume: every
        how many tracking replies; wrap (of the frame number, soon after tracking starts) has none.
        """
        faults = cls(seed=seed)
        for specification in specifications:
            name, equals, text = specification.partition("=")
            try:
                value = float(text) if equals else None
                if name in _SHARES:
                    setattr(faults, name, _DEFAULT_SHARE if value is None else value)
                elif name == "silence":
                    faults.silence_s = _DEFAULT_SILENCE_S if value is None else value
                elif name in ("disconnect", "out-of-volume"):
                    setattr(faults, name.replace("-", "_"), True)
                    faults.period = _DEFAULT_PERIOD if value is None else int(value)
                elif name == "wrap":
                    faults.wrap = True
                else:
                    raise ValueError
            except ValueError:
                known = ", ".join((*_SHARES, "silence", "disconnect", "out-of-volume", "wrap"))
                raise DeviceInputError(
                    f"fault {specification!r}: expected NAME or NAME=VALUE with one of {known}"
                ) from None
        faults.__post_init__()
        return faults

    def once(self, name: str) -> None:
        """Let a fault (``"cut"``, …, ``"disconnect"``) happen to the next reply."""
        self._once.append(name)

    def moment(self) -> bool:
        """Count one tracking reply; tell whether its number calls for a periodic fault."""
        self._tracking_replies += 1
        return self._tracking_replies % self.period == 0

    def deliver(self, reply: bytes, due: bool) -> list[Delivery]:
        """Decide what becomes of a reply; `due` as `moment` told for it."""
        once = self._once.pop(0) if self._once else ""
        if once == "disconnect" or (due and self.disconnect):
            self._note("disconnect")
            return [Delivery(b"", disconnect=True)]
        if once == "silence" or (due and self.silence_s > 0.0):
            self._note("silence")
            return [Delivery(b"", delay_s=self.silence_s or _DEFAULT_SILENCE_S)]
        delivery = Delivery(reply)
        if self._hits("corrupt", once):
            damaged = bytearray(reply)
            for _ in range(self._random.randint(1, 3)):
                damaged[self._random.randrange(len(damaged))] ^= self._random.randint(1, 255)
            delivery.data = bytes(damaged)
        if self._hits("cut", once):
            delivery.data = delivery.data[: self._random.randrange(len(reply))]
        if self._hits("late", once):
            delivery.delay_s = self.late_s
        if self._hits("duplicate", once):
            return [delivery, Delivery(delivery.data)]
        return [delivery]

    def _hits(self, name: str, once: str) -> bool:
        hit = once == name or self._random.random() < getattr(self, name)
        if hit:
            self._note(name)
        return hit

    def _note(self, name: str) -> None:
        self.happened[name] = self.happened.get(name, 0) + 1
