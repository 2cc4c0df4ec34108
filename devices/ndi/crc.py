"""CRC-16/ARC, the checksum of every NDI command and reply."""

from __future__ import annotations

__all__ = ["crc16"]


def _table() -> tuple[int, ...]:
    entries = []
    for byte in range(256):
        value = byte
        for _ in range(8):
            value = (value >> 1) ^ (0xA001 if value & 1 else 0)
        entries.append(value)
    return tuple(entries)


_TABLE = _table()


def crc16(message: bytes) -> int:
    """CRC-16/ARC of a message: polynomial 0x8005 reflected, start 0, no final inversion.

    >>> f"{crc16(b'OKAY'):04X}"
    'A896'
    """
    value = 0
    for byte in message:
        value = (value >> 8) ^ _TABLE[(value ^ byte) & 0xFF]
    return value
