"""The errors of `guidance`: one base, each with the built-in error a caller may already catch."""

from __future__ import annotations


class GuidanceError(Exception):
    """Base of every error raised by `guidance`."""


class InputError(GuidanceError, ValueError):
    """An argument or a file that cannot be used; the message says what was got, what was expected, and what to do."""
