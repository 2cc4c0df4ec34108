"""Where is the needle? Trackers: bytes in, timed poses out.

Names are imported on first use, so that a simulation never loads a serial port.

>>> import devices
>>> clock = devices.ManualClock()
>>> clock.now_s()
0.0
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from devices.clock import Clock, ManualClock, SystemClock
    from devices.errors import DeviceError, DeviceInputError, ProtocolError, TrackerError, TransportError
    from devices.frame import ToolPose, ToolStatus, TrackerFrame
    from devices.igtl import IgtlServer, IgtlTracker
    from devices.ndi.tracker import NdiTracker
    from devices.recording import Recorder, ReplayTracker
    from devices.registry import open_tracker
    from devices.simulated import SimulatedTracker
    from devices.stream import Stream, StreamCounters
    from devices.tracker import Tracker

_HOMES = {
    "clock": ("Clock", "ManualClock", "SystemClock"),
    "errors": ("DeviceError", "DeviceInputError", "ProtocolError", "TrackerError", "TransportError"),
    "frame": ("ToolPose", "ToolStatus", "TrackerFrame"),
    "igtl": ("IgtlServer", "IgtlTracker"),
    "ndi.tracker": ("NdiTracker",),
    "recording": ("Recorder", "ReplayTracker"),
    "registry": ("open_tracker",),
    "simulated": ("SimulatedTracker",),
    "stream": ("Stream", "StreamCounters"),
    "tracker": ("Tracker",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "Clock",
    "DeviceError",
    "DeviceInputError",
    "IgtlServer",
    "IgtlTracker",
    "ManualClock",
    "NdiTracker",
    "ProtocolError",
    "Recorder",
    "ReplayTracker",
    "SimulatedTracker",
    "Stream",
    "StreamCounters",
    "SystemClock",
    "ToolPose",
    "ToolStatus",
    "Tracker",
    "TrackerError",
    "TrackerFrame",
    "TransportError",
    "open_tracker",
]


def __getattr__(name: str) -> Any:
    try:
        home = _HOME_OF[name]
    except KeyError:
        raise AttributeError(f"module 'devices' has no attribute {name!r}") from None
    value = getattr(import_module(f"devices.{home}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
