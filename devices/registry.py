"""`open_tracker`: one URL names a tracker, wherever its poses come from."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

from devices.clock import Clock
from devices.errors import DeviceInputError
from devices.recording import ReplayTracker
from devices.simulated import SimulatedTracker
from devices.tracker import Tracker

__all__ = ["open_tracker", "read_waypoints"]

Parameters = dict[str, list[str]]


def open_tracker(url: str, clock: Clock | None = None) -> Tracker:
    """Make the tracker that a URL names; it is opened by `start` or a ``with`` block.

    Parameters
    ----------
    url : str
        * ``sim:PLAN.json?seed=1&rate=60&noise_mm=0.2``: a JSON object with ``"waypoints": {tool: [{"time_s": …,
          "T_tracker_tool": [[…]]}, …]}``; further parameters as `SimulatedTracker` has them (``rate`` for ``rate_hz``),
          ``occlusion=TOOL,START,END`` any number of times.
        * ``replay:FILE?rate=2``: a recording; ``rate=step`` returns frame after frame without waiting.
        * ``ndi:/dev/ttyUSB0?rom=a.rom&rom=b.rom`` or ``ndi:tcp://HOST:8765?…``: an NDI tracker; parameters as
          `NdiTracker` has them.
        * ``igtl://HOST:PORT``: an OpenIGTLink server.
    clock : Clock or None
        The machine's own by default.

    Raises
    ------
    DeviceInputError
        Where the URL names no known kind, a parameter is unknown or cannot be read, or a file is missing or wrong.
    """
    kind, colon, rest = url.partition(":")
    if not colon or kind not in _OPENERS:
        raise DeviceInputError(
            f"{url!r}: expected a tracker URL that starts with {', '.join(f'{k}:' for k in _OPENERS)}"
        )
    place, _, query = rest.partition("?")
    if not place:
        raise DeviceInputError(f"{url!r}: nothing after {kind}:; give a file, a device or a host")
    try:
        parameters = parse_qs(query, keep_blank_values=True, strict_parsing=bool(query))
    except ValueError:
        raise DeviceInputError(f"{url!r}: expected ?name=value&name=value after the place, got ?{query}") from None
    return _OPENERS[kind](url, place, parameters, clock)


def read_waypoints(path: str | Path) -> dict[str, list[tuple[float, list[list[float]]]]]:
    """Read the ``waypoints`` of a JSON object: per tool a list of (time_s, (4, 4) T_tracker_tool in mm)."""
    try:
        document = json.loads(Path(path).read_text(encoding="utf-8"))
        return {
            str(tool): [(float(point["time_s"]), point["T_tracker_tool"]) for point in points]
            for tool, points in document["waypoints"].items()
        }
    except OSError as error:
        raise DeviceInputError(f"{path}: cannot be read: {error}") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DeviceInputError(
            f'{path}: expected {{"waypoints": {{tool: [{{"time_s": …, "T_tracker_tool": [[4×4]]}}, …]}}}}; '
            f"{type(error).__name__}: {error}"
        ) from None


def _taken(url: str, parameters: Parameters, readers: Mapping[str, Callable[[str], Any]]) -> dict[str, Any]:
    """Parse single-valued parameters; refuse unknown and repeated ones."""
    values = {}
    for name, texts in parameters.items():
        if name not in readers:
            raise DeviceInputError(f"{url!r}: unknown parameter {name!r}; known: {', '.join(sorted(readers))}")
        if len(texts) != 1:
            raise DeviceInputError(f"{url!r}: parameter {name!r} is given {len(texts)} times")
        try:
            values[name] = readers[name](texts[0])
        except ValueError:
            raise DeviceInputError(f"{url!r}: {name}={texts[0]!r} cannot be read") from None
    return values


def _flag(text: str) -> bool:
    if text.lower() in ("1", "true", "yes", ""):
        return True
    if text.lower() in ("0", "false", "no"):
        return False
    raise ValueError(text)


def _occlusion(text: str) -> tuple[str, float, float]:
    tool, start_s, end_s = text.rsplit(",", 2)
    return tool, float(start_s), float(end_s)


def _open_sim(url: str, place: str, parameters: Parameters, clock: Clock | None) -> Tracker:
    floats = ("noise_mm", "noise_deg", "jitter_s", "latency_s", "dropout", "outlier_share", "outlier_mm")
    readers: dict[str, Callable[[str], Any]] = dict.fromkeys(floats, float)
    readers |= {"rate": float, "rate_hz": float, "seed": int, "timestamps": _flag}
    try:
        occlusions = [_occlusion(text) for text in parameters.pop("occlusion", [])]
    except ValueError:
        raise DeviceInputError(f"{url!r}: expected occlusion=TOOL,START,END in seconds") from None
    values = _taken(url, parameters, readers)
    if "rate" in values:
        values["rate_hz"] = values.pop("rate")
    return SimulatedTracker(read_waypoints(place), occlusions=occlusions, clock=clock, **values)


def _open_replay(url: str, place: str, parameters: Parameters, clock: Clock | None) -> Tracker:
    values = _taken(url, parameters, {"rate": lambda text: None if text.lower() in ("step", "none") else float(text)})
    return ReplayTracker(place, clock=clock, **values)


def _open_ndi(url: str, place: str, parameters: Parameters, clock: Clock | None) -> Tracker:
    from devices.ndi.tracker import NdiTracker

    roms, names = parameters.pop("rom", []), parameters.pop("name", [])
    readers: dict[str, Callable[[str], Any]] = {"baud_rate": int, "mode": str, "latency_s": float}
    readers |= {"wired": _flag, "markers": _flag, "strays": _flag, "reply_timeout_s": float, "command_timeout_s": float}
    return NdiTracker(place, roms=roms, names=names, clock=clock, **_taken(url, parameters, readers))


def _open_igtl(url: str, place: str, parameters: Parameters, clock: Clock | None) -> Tracker:
    from devices.igtl import DEFAULT_PORT, IgtlTracker

    host, colon, port = place.removeprefix("//").rstrip("/").rpartition(":")
    if not colon:
        host, port = port, str(DEFAULT_PORT)
    if not port.isdigit():
        raise DeviceInputError(f"{url!r}: expected igtl://HOST:PORT")
    return IgtlTracker(host.strip("[]"), int(port), clock=clock, **_taken(url, parameters, {"latency_s": float}))


_OPENERS: dict[str, Callable[[str, str, Parameters, Clock | None], Tracker]] = {
    "sim": _open_sim,
    "replay": _open_replay,
    "ndi": _open_ndi,
    "igtl": _open_igtl,
}
