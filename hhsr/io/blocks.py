"""Numbers to bytes and back without loss: varints, and blocks of floats in the smallest form that holds them exactly.

A block is a head byte, where needed an exponent e, and its numbers. Kinds:

* F8, F4: little-endian IEEE floats (F4 only where every value is a float32).
* PACKED: every value is m · 2^e with |m| < 2^32; magnitudes of `width` bits, sign bits first where a value is negative.
* RICE: the same integers, sign in the lowest bit where needed, as Golomb-Rice codes of parameter `width`: all unary
  quotients, then all remainders. Shorter than PACKED for weights, which are small more often than large.

So who quantises chooses a power-of-two step and rounds to it; nothing has to be told to the file. A sign is stored
apart from its magnitude, so −0.0 comes back as −0.0. Counts are not in a block: the tree's structure tells them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hhsr.errors import FileFormatError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

F8, F4, PACKED, RICE = range(4)
_SIGNED = 4
_MAX_BITS = 32
_MAX_QUOTIENT = 32


class Writer:
    """Collects bytes."""

    def __init__(self) -> None:
        self._parts = bytearray()

    def written(self) -> bytes:
        """Return what was written so far."""
        return bytes(self._parts)

    def raw(self, data: bytes) -> None:
        """Append bytes as they are; the reader must know how many."""
        self._parts += data

    def sized(self, data: bytes) -> None:
        """Append bytes with their count before them."""
        self.varint(len(data))
        self.raw(data)

    def varint(self, value: int) -> None:
        """Append an integer ≥ 0, seven bits a byte, low bits first."""
        while value >= 0x80:
            self._parts.append(value & 0x7F | 0x80)
            value >>= 7
        self._parts.append(value)

    def floats(self, values: ArrayLike) -> None:
        """Append a block of floats in the shortest of the forms that hold them exactly."""
        self.raw(float_block(np.asarray(values, dtype=np.float64).ravel()))

    def integers(self, values: IntArray, limit: int) -> None:
        """Append integers in [0, limit), each in as many bits as limit − 1 needs."""
        self.raw(_pack(values, _width(limit)))


class Reader:
    """Reads what a Writer wrote; FileFormatError where the bytes end early or make no sense."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    @property
    def left(self) -> int:
        """Bytes not yet read."""
        return len(self._data) - self._at

    def raw(self, count: int) -> bytes:
        """Return the next `count` bytes."""
        if count > self.left:
            raise FileFormatError(f"the file's body needs {count} more bytes at byte {self._at}, got {self.left}")
        self._at += count
        return self._data[self._at - count : self._at]

    def sized(self) -> bytes:
        """Return bytes that were written with their count."""
        return self.raw(self.varint())

    def varint(self) -> int:
        """Return an integer ≥ 0, below 2^63."""
        value = 0
        for shift in range(0, 63, 7):
            byte = self.raw(1)[0]
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
        raise FileFormatError(f"a number at byte {self._at} runs over nine bytes")

    def floats(self, count: int) -> FloatArray:
        """Return (count,) floats of a block."""
        if count == 0:
            return np.zeros(0)
        if count > 8 * self.left:  # each takes a bit at least: never allocate for more
            raise FileFormatError(f"a block of {count} numbers does not fit in {self.left} bytes")
        head = self.raw(1)[0]
        kind, signed, width = head & 3, bool(head & _SIGNED), head >> 3
        if kind in (F8, F4):
            size = 8 if kind == F8 else 4
            return np.frombuffer(self.raw(count * size), dtype=f"<f{size}").astype(np.float64)
        exponent = _unzigzag(self.varint())
        if not -1100 <= exponent <= 1100:
            raise FileFormatError(f"a block's scale is 2^{exponent}, expected a float's exponent")
        if kind == PACKED:
            negative = self._unpacked(count, 1).astype(bool) if signed else np.zeros(count, dtype=bool)
            magnitude = self._unpacked(count, width + 1)
        else:
            magnitude = self._rice(count, width)
            negative = (magnitude & 1).astype(bool) if signed else np.zeros(count, dtype=bool)
            magnitude = magnitude >> 1 if signed else magnitude
        with np.errstate(over="ignore"):  # a value out of range is refused by the tree's check, as not finite
            values = np.ldexp(magnitude.astype(np.float64), exponent)
        return np.asarray(np.where(negative, -values, values))

    def integers(self, count: int, limit: int) -> IntArray:
        """Return (count,) integers in [0, limit)."""
        values = self._unpacked(count, _width(limit))
        if count and int(values.max()) >= limit:
            raise FileFormatError(f"an index is {int(values.max())}, expected below {limit}")
        return values

    def _unpacked(self, count: int, width: int) -> IntArray:
        data = self.raw(-(-count * width // 8))
        bits = np.unpackbits(np.frombuffer(data, dtype=np.uint8), count=count * width).reshape(count, width)
        return bits @ (np.int64(1) << np.arange(width - 1, -1, -1, dtype=np.int64))

    def _rice(self, count: int, width: int) -> IntArray:
        longest = min(((_MAX_QUOTIENT + 1) * count) // 8 + 1, self.left)
        unary = np.frombuffer(self._data, dtype=np.uint8, count=longest, offset=self._at)
        ones = np.flatnonzero(np.unpackbits(unary))[:count]
        if ones.size < count:
            raise FileFormatError(f"a block has {ones.size} numbers, expected {count}")
        self.raw(int(ones[-1]) // 8 + 1)
        quotients = np.diff(ones, prepend=-1) - 1
        return (quotients << width) + (self._unpacked(count, width) if width else 0)


def float_block(values: FloatArray) -> bytes:
    """Return the shortest block that holds (n,) finite floats exactly; nothing where n = 0."""
    if values.size == 0:
        return b""
    choices = [bytes([F8]) + values.astype("<f8").tobytes()]
    with np.errstate(over="ignore", under="ignore"):
        single = values.astype("<f4")
    if np.array_equal(single.astype(np.float64), values):
        choices.append(bytes([F4]) + single.tobytes())
    choices += _integer_blocks(values)
    return min(choices, key=len)


def _integer_blocks(values: FloatArray) -> list[bytes]:
    """Return the PACKED and the RICE block, where all values are integers of ≤ 32 bits times one power of two."""
    fraction, exponents = np.frexp(np.abs(values))
    mantissa = (fraction * 2.0**53).astype(np.int64)
    if mantissa.any():
        some = mantissa != 0
        lowest = mantissa[some] & -mantissa[some]
        exponent = int((exponents[some] - 53 + np.frexp(lowest.astype(np.float64))[1] - 1).min())
        largest = int(exponents[some].max()) - exponent
        if largest > _MAX_BITS:
            return []
    else:
        exponent, largest = 0, 1
    magnitude = np.ldexp(np.abs(values), -exponent).astype(np.int64)
    negative = np.signbit(values)
    signed = bool(negative.any())
    sign_bit = _SIGNED if signed else 0
    scale = Writer()
    scale.varint(_zigzag(exponent))
    signs = _pack(negative.astype(np.int64), 1) if signed else b""
    packed = bytes([PACKED | sign_bit | largest - 1 << 3]) + scale.written() + signs + _pack(magnitude, largest)
    codes = magnitude * 2 + negative if signed else magnitude
    width = _rice_width(codes)
    if int((codes >> width).sum()) > _MAX_QUOTIENT * values.size:  # never shorter; and lets the reader bound its search
        return [packed]
    return [packed, bytes([RICE | sign_bit | width << 3]) + scale.written() + _rice(codes, width)]


def _rice_width(codes: IntArray) -> int:
    lengths = [codes.size * (1 + width) + int((codes >> width).sum()) for width in range(_MAX_BITS)]
    return int(np.argmin(lengths))


def _rice(codes: IntArray, width: int) -> bytes:
    ends = np.cumsum((codes >> width) + 1) - 1
    bits = np.zeros(int(ends[-1]) + 1, dtype=np.uint8)
    bits[ends] = 1
    return np.packbits(bits).tobytes() + _pack(codes & ((1 << width) - 1), width)


def _pack(values: IntArray, width: int) -> bytes:
    shifts = np.arange(width - 1, -1, -1, dtype=np.int64)
    return np.packbits((values[:, None] >> shifts & 1).astype(np.uint8)).tobytes()


def _width(limit: int) -> int:
    return max((limit - 1).bit_length(), 1)


def _zigzag(value: int) -> int:
    return 2 * value if value >= 0 else -2 * value - 1


def _unzigzag(value: int) -> int:
    return value >> 1 if value & 1 == 0 else -(value + 1) >> 1
