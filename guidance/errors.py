"""What guidance raises: one base, each error also the built-in that a caller would expect."""

from __future__ import annotations


class GuidanceError(Exception):
    """Base of everything that `guidance` raises on purpose."""


class InputError(GuidanceError, ValueError):
    """An argument has the wrong shape, is not finite, or is outside of its range."""


class SceneError(GuidanceError, ValueError):
    """A scene file or a scene's parts do not make sense together; the message says what to change."""


class LogError(GuidanceError, ValueError):
    """A session log cannot be read, or its replay does not give what was recorded."""
