"""Record any tracker as JSON lines, and replay recordings as a tracker.

The first line is ``{"format": "tracker-recording", "version": 1, …}``; every further line is one frame. Numbers are
written so that they read back bit for bit; NaN is ``null``, infinities are strings.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from devices.clock import Clock
from devices.csv_recordings import read_csv_frames
from devices.errors import DeviceInputError
from devices.frame import ToolPose, ToolStatus, TrackerFrame
from devices.tracker import Tracker

__all__ = ["Recorder", "ReplayTracker", "read_recording"]

_FORMAT = "tracker-recording"
_VERSION = 1


def _number(value: float) -> float | str | None:
    if math.isfinite(value):
        return float(value)
    return None if math.isnan(value) else repr(float(value))


def _numbers(array: NDArray[np.float64]) -> list[list[float | str | None]]:
    return [[_number(value) for value in row] for row in array.tolist()]


def _parsed(value: Any) -> float:
    return math.nan if value is None else float(value)


def _matrix(rows: Any, columns: int) -> NDArray[np.float64] | None:
    if rows is None:
        return None
    return np.array([[_parsed(value) for value in row] for row in rows], dtype=np.float64).reshape(-1, columns)


def _frame_record(frame: TrackerFrame) -> dict[str, Any]:
    tools: dict[str, Any] = {}
    for name, pose in frame.tools.items():
        record: dict[str, Any] = {"status": pose.status.name}
        if pose.T_tracker_tool is not None:
            record["T_tracker_tool"] = _numbers(pose.T_tracker_tool)
        if not math.isnan(pose.error_mm):
            record["error_mm"] = _number(pose.error_mm)
        if pose.markers_mm is not None:
            record["markers_mm"] = _numbers(pose.markers_mm)
        if pose.switches:
            record["switches"] = pose.switches
        tools[name] = record
    line: dict[str, Any] = {"number": frame.number, "time_s": _number(frame.time_s)}
    line |= {"arrival_s": _number(frame.arrival_s), "tools": tools}
    if frame.strays_mm is not None:
        line["strays_mm"] = _numbers(frame.strays_mm)
    return line


def _frame(record: Mapping[str, Any]) -> TrackerFrame:
    tools = {}
    for name, tool in record["tools"].items():
        tools[name] = ToolPose(
            ToolStatus[tool["status"]],
            _matrix(tool.get("T_tracker_tool"), 4),
            _parsed(tool.get("error_mm")),
            _matrix(tool.get("markers_mm"), 3),
            int(tool.get("switches", 0)),
        )
    strays = _matrix(record.get("strays_mm"), 3)
    return TrackerFrame(int(record["number"]), _parsed(record["time_s"]), _parsed(record["arrival_s"]), tools, strays)


class Recorder:
    """Write frames to a JSON-lines file, each one flushed before `write` returns.

    Parameters
    ----------
    path : str or Path
        Written anew.
    source : str
        A note for the header: where the frames came from.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.jsonl"
    >>> with Recorder(path) as recorder:
    ...     recorder.write(TrackerFrame(1, 0.5, 0.6, {"needle": ToolPose(ToolStatus.MISSING, None)}))
    >>> [frame.number for frame in read_recording(path)]
    [1]
    """

    def __init__(self, path: str | Path, source: str = "") -> None:
        self.path = Path(path)
        self.frames = 0
        self._file = self.path.open("w", encoding="utf-8")
        self._line({"format": _FORMAT, "version": _VERSION, "units": "mm, s", "source": source})

    def write(self, frame: TrackerFrame) -> None:
        """Append one frame."""
        self._line(_frame_record(frame))
        self.frames += 1

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        self._file.close()

    def _line(self, record: Mapping[str, Any]) -> None:
        self._file.write(json.dumps(record, allow_nan=False, separators=(",", ":")) + "\n")
        self._file.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _read_json_lines(path: Path, text: str) -> list[TrackerFrame]:
    lines = text.split("\n")
    try:
        header = json.loads(lines[0])
        known = header["format"] == _FORMAT and header["version"] == _VERSION
    except (ValueError, KeyError, TypeError):
        known = False
    if not known:
        raise DeviceInputError(
            f"{path}: first line is no header of a version {_VERSION} {_FORMAT}, nor of a known CSV: {lines[0][:80]!r}"
        )
    frames = []
    for row, line in enumerate(lines[1:], start=2):
        if not line:
            continue
        try:
            frames.append(_frame(json.loads(line)))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            # a recording that was cut while it was written lacks the end of its last line, and only that
            if row == len(lines):
                break
            raise DeviceInputError(f"{path}: line {row} is no frame ({error}): {line[:80]!r}") from None
    return frames


def read_recording(path: str | Path) -> list[TrackerFrame]:
    """Read all frames of a recording.

    Parameters
    ----------
    path : str or Path
        JSON lines of `Recorder`, a CSV with one row per frame and transform (``frame,timestamp,…,m00…m23``), or an
        NDI Aurora CSV with one row per sample.

    Returns
    -------
    list of TrackerFrame

    Raises
    ------
    DeviceInputError
        Where the file is missing, of no known format, or holds a line that is no frame. A last line cut short is no
        error: what came before it is returned.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DeviceInputError(f"{path}: cannot be read as a recording: {error}") from error
    frames = read_csv_frames(path, text)
    return _read_json_lines(path, text) if frames is None else frames


class ReplayTracker(Tracker):
    """A tracker that replays a recording; its frames are the recorded ones, numbers and times unchanged.

    Parameters
    ----------
    path : str, Path, or sequence of TrackerFrame
        What `read_recording` reads, or frames.
    rate : float or None
        Speed against the recording's own arrival times: 1 as recorded, 10 ten times as fast; None steps: each `read`
        returns the next frame at once.
    clock : Clock or None
        The clock that is waited on (not the clock of the frames: that is the recording's, see `now_s`).
    """

    def __init__(
        self, path: str | Path | Sequence[TrackerFrame], rate: float | None = 1.0, clock: Clock | None = None
    ) -> None:
        super().__init__(clock)
        if rate is not None and not 0.0 < rate < math.inf:
            raise DeviceInputError(f"rate: expected a finite number > 0, or None to step, got {rate!r}")
        self.rate = rate
        self._frames = read_recording(path) if isinstance(path, str | Path) else list(path)
        self._position = 0
        self._started_s = 0.0

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def tool_names(self) -> tuple[str, ...]:
        """Names of all tools that occur, in order of appearance."""
        return tuple(dict.fromkeys(name for frame in self._frames for name in frame.tools))

    @property
    def is_finished(self) -> bool:
        """Whether the last frame has been delivered."""
        return self._position >= len(self._frames)

    def frames(self) -> Iterator[TrackerFrame]:
        """Iterate over all frames without waiting."""
        return iter(self._frames)

    def now_s(self) -> float:
        """Return the present on the recording's own clock, s."""
        if not self._frames:
            return 0.0
        if self.rate is None:
            return self._frames[max(0, self._position - 1)].arrival_s
        return self._frames[0].arrival_s + (self.clock.now_s() - self._started_s) * self.rate

    def _start(self) -> None:
        self._position = 0
        self._started_s = self.clock.now_s()

    def _read(self, timeout_s: float) -> TrackerFrame | None:
        if self.is_finished:
            return None
        frame = self._frames[self._position]
        if self.rate is not None:
            due_s = self._started_s + (frame.arrival_s - self._frames[0].arrival_s) / self.rate
            limit_s = self.clock.now_s() + timeout_s
            self.clock.wait_until(min(due_s, limit_s), self._stopping)
            if due_s > limit_s or self._stopping.is_set():
                return None
        self._position += 1
        return frame
