"""The errors of `devices`: one base, each with the built-in error a caller may already catch.

A tool without a pose is no error: it is a `ToolPose` whose status says why.
"""

from __future__ import annotations


class DeviceError(Exception):
    """Base of every error raised by `devices`."""


class DeviceInputError(DeviceError, ValueError):
    """An argument, URL or file that cannot be used."""


class ProtocolError(DeviceError, ValueError):
    """Bytes that are no valid message of the protocol; nothing of them was used."""


class TransportError(DeviceError, OSError):
    """The line is closed, cut or silent; a tracker that raised it may be read again and then tries to reconnect."""


class TrackerError(DeviceError, RuntimeError):
    """The device, or its state, refuses what was asked.

    Parameters
    ----------
    message : str
        What was asked, what came back, what to do.
    code : int or None
        The device's own error code where it sent one.
    """

    def __init__(self, message: str, code: int | None = None) -> None:
        super().__init__(message)
        self.code = code
