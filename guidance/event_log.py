"""The session on disk: events for people, inputs for replay.

`events.jsonl` has one line per change of state. `session.jsonl` has a header (scene, transforms, limits), then every
frame and tick in order, each with the digest of the report it gave: feeding them to a new monitor must give the
same digests.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from math import nan
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

import numpy as np

from devices.frame import ToolPose, ToolStatus, TrackerFrame
from guidance.errors import LogError
from guidance.limits import Limits
from guidance.monitor import Monitor
from guidance.scene import Scene
from guidance.states import Report, number
from guidance.trajectory import Trajectory

SESSION_VERSION = 1


class EventLog:
    """Writes `events.jsonl`, one flushed line per event, and if asked the inputs for a replay.

    Parameters
    ----------
    events : Path
    session : Path or None
        File for the inputs.
    header : mapping
        First line of the session file, from `session_header`.
    run : str
        Added to each event where several runs go to one file.
    """

    def __init__(
        self, events: Path, session: Path | None = None, header: Mapping[str, Any] | None = None, run: str = ""
    ) -> None:
        self._events: TextIO = events.open("a", encoding="utf-8")
        self._session: TextIO | None = None
        self._run = run
        if session is not None:
            self._session = session.open("w", encoding="utf-8")
            self._write(self._session, dict(header or {}))

    def __enter__(self) -> EventLog:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Close both files; closing twice does no harm."""
        self._events.close()
        if self._session is not None:
            self._session.close()

    def frame(self, frame: TrackerFrame, report: Report) -> None:
        """Log a frame and what came of it."""
        self._log({"frame": _frame_record(frame)}, report)

    def tick(self, now: float, report: Report) -> None:
        """Log a tick and what came of it."""
        self._log({"tick": now}, report)

    def _log(self, entry: dict[str, Any], report: Report) -> None:
        for event in report.events:
            record = event.to_record()
            self._write(self._events, {**record, "run": self._run} if self._run else record)
        if self._session is not None:
            self._write(self._session, {**entry, "report": report.digest})

    @staticmethod
    def _write(file: TextIO, record: dict[str, Any]) -> None:
        file.write(json.dumps(record) + "\n")
        file.flush()


def session_header(monitor: Monitor) -> dict[str, Any]:
    """What a replay must start from."""
    path = monitor.path
    return {
        "session": SESSION_VERSION,
        "scene": monitor.scene.name,
        "scene_hash": monitor.scene.hash,
        "shapes": {s.name: s.hash for s in monitor.scene.structures},
        "path": None if path is None else path.to_record(),
        "tool": monitor.tool,
        "T_patient_tracker": _matrix(monitor.T_patient_tracker),
        "T_tool_tip": _matrix(monitor.T_tool_tip),
        "limits": monitor.limits.to_record(),
    }


def replay(session: Path, scene: Scene) -> Iterator[tuple[Report, bool]]:
    """Feed a session's inputs to a new monitor; yield each report and whether it is the recorded one, bit for bit.

    Raises
    ------
    LogError
        If the file is no session, or was recorded with another scene.
    """
    with session.open(encoding="utf-8") as lines:
        header = _record(next(lines, ""), session, 1)
        if header.get("session") != SESSION_VERSION:
            raise LogError(f"{session} is not a session log of version {SESSION_VERSION}")
        if header["scene_hash"] != scene.hash:
            raise LogError(
                f"{session} was recorded with scene {header['scene']!r} ({header['scene_hash']}), "
                f"this one is {scene.name!r} ({scene.hash}); replay it with the shapes it was made with"
            )
        path = None if header["path"] is None else Trajectory.from_record(header["path"])
        monitor = Monitor(
            scene, path, header["tool"], header["T_patient_tracker"], header["T_tool_tip"], Limits(**header["limits"])
        )
        for line_number, line in enumerate(lines, start=2):
            record = _record(line, session, line_number)
            report = monitor.tick(record["tick"]) if "tick" in record else monitor.update(_frame(record["frame"]))
            yield report, report.digest == record["report"]


def _record(line: str, path: Path, number: int) -> dict[str, Any]:
    try:
        record = json.loads(line)
    except json.JSONDecodeError as error:
        raise LogError(f"{path}, line {number}: not JSON ({error})") from None
    if not isinstance(record, dict):
        raise LogError(f"{path}, line {number}: expected a JSON object")
    return record


def _matrix(T: Any) -> Any:
    """Rows of numbers; what is not finite becomes null (JSON has no NaN)."""
    return None if T is None else [[number(v) for v in row] for row in np.asarray(T, dtype=np.float64)]


def _frame_record(frame: TrackerFrame) -> dict[str, Any]:
    tools = {n: [p.status.name, _matrix(p.T_tracker_tool), number(p.error_mm)] for n, p in frame.tools.items()}
    times = {"time_s": number(frame.time_s), "arrival_s": number(frame.arrival_s)}
    return {"number": frame.number, **times, "tools": tools}


def _frame(record: dict[str, Any]) -> TrackerFrame:
    tools = {
        n: ToolPose(ToolStatus[status], None if T is None else np.asarray(T, dtype=np.float64), _float(error))
        for n, (status, T, error) in record["tools"].items()
    }
    return TrackerFrame(record["number"], _float(record["time_s"]), _float(record["arrival_s"]), tools)


def _float(value: float | None) -> float:
    return nan if value is None else value
