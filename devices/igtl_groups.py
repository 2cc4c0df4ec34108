"""Which OpenIGTLink messages of single tools make up one frame."""

from __future__ import annotations

from devices.frame import ToolPose

__all__ = ["MessageGroups"]


class MessageGroups:
    """Gather messages of single tools into frames.

    Messages with one timestamp belong together. A group is closed at once when the tools are there that came together
    the last time, otherwise by the next timestamp, a repeated name, or a pause; so no tool waits without need.
    """

    def __init__(self) -> None:
        self.current: dict[str, ToolPose] = {}
        self.stamp_s = 0.0
        self._last: set[str] = set()
        self._late = False
        self._last_stamp_s = 0.0
        self._companions: dict[str, set[str]] = {}

    def closes(self, name: str, stamp_s: float) -> bool:
        """Whether a message of that name and time belongs to the next group."""
        return bool(self.current) and (stamp_s != self.stamp_s or name in self.current)

    def add(self, name: str, stamp_s: float, pose: ToolPose) -> bool:
        """Add a tool; tell whether the group is whole."""
        self.stamp_s = stamp_s
        self.current[name] = pose
        if stamp_s > 0.0 and stamp_s == self._last_stamp_s and name not in self._last:
            # it came too late for its group: wait for it the next time
            self._late = True
            self._last.add(name)
            self._companions.update(dict.fromkeys(self._last, self._last))
            return True
        return self._companions.get(name) == self.current.keys()

    def take(self) -> tuple[dict[str, ToolPose], float, bool]:
        """Close the group: its tools, its time, and whether it repeats the time of the last one (old data)."""
        tools, stamp_s = self.current, self.stamp_s
        repeated = stamp_s > 0.0 and stamp_s == self._last_stamp_s and not self._late
        if not self._late:
            self._last, self._last_stamp_s = set(tools), stamp_s
            self._companions.update(dict.fromkeys(tools, self._last))
        self._late = False
        self.current = {}
        return tools, stamp_s, repeated
