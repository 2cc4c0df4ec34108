"""What can go wrong, as types a caller can catch: one base, and the built-in error that says the same."""

from __future__ import annotations


class HhsrError(Exception):
    """Base of every error raised by hhsr."""


class InputError(HhsrError, ValueError):
    """An argument is not what the function takes; the message says what was got, expected, and what to do."""


class SurfaceError(InputError):
    """A surface cannot be used as an organ's boundary (open beyond repair, empty label, implausible size)."""


class FileFormatError(HhsrError, ValueError):
    """A file is not a valid .hhsr file, or of a version this software does not know."""


class FitError(HhsrError, RuntimeError):
    """A fit could not be made within its options (a budget that cannot hold what must be retained)."""


class QueryError(HhsrError, RuntimeError):
    """A query could not be answered with proof."""
