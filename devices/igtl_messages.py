"""OpenIGTLink messages to bytes and back, without any I/O: TRANSFORM, TDATA, POSITION, STATUS.

Big-endian throughout. Headers of version 1 and 2 (with extended header and metadata) are read; version 1 is written,
which every peer reads.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from devices.errors import DeviceInputError, ProtocolError
from devices.rotation import is_rigid, pose_from_quaternion, quaternion_from_rotation

__all__ = [
    "DEFAULT_PORT",
    "HEADER_BYTES",
    "Message",
    "MessageReader",
    "Status",
    "crc64",
    "decode_poses",
    "decode_status",
    "encode",
    "encode_status",
    "encode_transform",
    "encode_transforms",
]

Array = NDArray[np.float64]

DEFAULT_PORT = 18944
HEADER_BYTES = 58
_HEADER = struct.Struct(">H12s20sIIQQ")
_EXTENDED = struct.Struct(">HHII")
_TDATA_ITEM = struct.Struct(">20sBB12f")
_LONGEST_BODY = 1 << 28
_NAME_BYTES = 20


_ALL_BITS = 0xFFFFFFFFFFFFFFFF
_POLYNOMIAL = 0x42F0E1EBA9EA3693
_BLOCK = 4096


def _byte_table() -> NDArray[np.uint64]:
    entries = []
    for byte in range(256):
        value = byte << 56
        for _ in range(8):
            value = ((value << 1) & _ALL_BITS) ^ (_POLYNOMIAL if value >> 63 else 0)
        entries.append(value)
    return np.array(entries, dtype=np.uint64)


_BYTE_TABLE = _byte_table()
#: row k: what a byte contributes that k bytes follow; the checksum is linear, so contributions are xored
_PLACES = _BYTE_TABLE[np.newaxis]


def _places(count: int) -> NDArray[np.uint64]:
    global _PLACES
    if len(_PLACES) < count:
        rows = list(_PLACES)
        while len(rows) < count:
            rows.append((rows[-1] << np.uint64(8)) ^ _BYTE_TABLE[rows[-1] >> np.uint64(56)])
        _PLACES = np.array(rows)
    return _PLACES


def crc64(body: bytes) -> int:
    """CRC-64/ECMA-182 of a message's body, by table look-ups for all bytes at once (2 µs for a TRANSFORM).

    >>> f"{crc64(b'123456789'):016X}"
    '6C40DF5F0B497347'
    """
    value = 0
    for start in range(0, len(body), _BLOCK):
        piece = body[start : start + _BLOCK]
        if len(piece) < 8:
            return _crc64_slowly(piece, value)
        block = np.frombuffer(piece, dtype=np.uint8)
        if value:  # what went before acts as if it were xored onto the next eight bytes
            block = block.copy()
            block[:8] ^= np.frombuffer(value.to_bytes(8, "big"), dtype=np.uint8)
        value = int(np.bitwise_xor.reduce(_places(len(block))[np.arange(len(block) - 1, -1, -1), block]))
    return value


def _crc64_slowly(tail: bytes, value: int) -> int:
    for byte in tail:
        value = ((value << 8) & _ALL_BITS) ^ int(_BYTE_TABLE[(value >> 56) ^ byte])
    return value


@dataclass(frozen=True)
class Message:
    """One message, its header read and its checksum right.

    Parameters
    ----------
    kind : str
        ``TRANSFORM``, ``TDATA``, …
    name : str
        The device's name, such as ``StylusTipToReference``.
    time_s : float
        Header timestamp, Unix time; 0 where the sender gave none.
    content : bytes
        Body without extended header and metadata.
    metadata : mapping of str to str
    """

    kind: str
    name: str
    time_s: float
    content: bytes
    metadata: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Status:
    """Content of a STATUS message: code 1 is OK, 13 not ready, 15 disabled, 16 not present."""

    code: int
    subcode: int
    error_name: str
    text: str


class MessageReader:
    """Turn bytes of a connection, cut anywhere, into messages.

    A body with a wrong checksum, or that cannot be one, is returned as a `ProtocolError`; reading goes on behind it.
    A header that cannot be one leaves no way to find the next: `lost` is set, and the connection has to be renewed.

    Parameters
    ----------
    wanted : collection of str or None
        Kinds to be checked and unpacked; messages of others (images among poses) come without content, unchecked:
        the checksum of an image of 1 MB takes 0.1 s, for which poses would wait. None: all.
    """

    def __init__(self, wanted: Collection[str] | None = None) -> None:
        self._buffer = bytearray()
        self._wanted = wanted
        self.lost = False

    @property
    def pending(self) -> int:
        """Number of bytes of a message that is not complete."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[Message | ProtocolError]:
        """Take bytes as they came; return what they complete, in order."""
        self._buffer += data
        done: list[Message | ProtocolError] = []
        while len(self._buffer) >= HEADER_BYTES and not self.lost:
            version, kind, name, seconds, fraction, size, checksum = _HEADER.unpack_from(self._buffer)
            if not 1 <= version <= 16 or size > _LONGEST_BODY or not kind.rstrip(b"\0").isascii():
                self.lost = True
                self._buffer.clear()
                done.append(ProtocolError(f"no OpenIGTLink header: version {version}, body of {size} bytes"))
                break
            if len(self._buffer) < HEADER_BYTES + size:
                break
            if self._wanted is not None and _label(kind) not in self._wanted:
                del self._buffer[: HEADER_BYTES + size]
                done.append(Message(_label(kind), _label(name), seconds + fraction / 2**32, b""))
                continue
            body = bytes(self._buffer[HEADER_BYTES : HEADER_BYTES + size])
            del self._buffer[: HEADER_BYTES + size]
            if crc64(body) != checksum:
                done.append(ProtocolError(f"checksum of a message {_text(kind)} from {_text(name)!r} is wrong"))
                continue
            try:
                content, metadata = _unwrapped(version, body)
            except ProtocolError as error:
                done.append(error)
                continue
            done.append(Message(_label(kind), _label(name), seconds + fraction / 2**32, content, metadata))
        return done


def _text(field_bytes: bytes) -> str:
    return field_bytes.split(b"\0")[0].decode("utf-8", "replace").strip()


#: the same few kinds and names come all the time
_label = lru_cache(1024)(_text)


def _unwrapped(version: int, body: bytes) -> tuple[bytes, dict[str, str]]:
    """Take the extended header and the metadata of version 2 off."""
    if version < 2:
        return body, {}
    try:
        extended, index_bytes, value_bytes, _ = _EXTENDED.unpack_from(body)
        end = len(body) - index_bytes - value_bytes
        if not _EXTENDED.size <= extended <= end:
            raise ProtocolError("extended header and metadata are larger than the message")
        metadata: dict[str, str] = {}
        if index_bytes:
            (count,) = struct.unpack_from(">H", body, end)
            at = end + index_bytes
            for k in range(count):
                key_bytes, _, length = struct.unpack_from(">HHI", body, end + 2 + 8 * k)
                key, value = body[at : at + key_bytes], body[at + key_bytes : at + key_bytes + length]
                metadata[key.decode("utf-8", "replace")] = value.decode("utf-8", "replace")
                at += key_bytes + length
        return body[extended:end], metadata
    except struct.error:
        raise ProtocolError("a message of version 2 is too short for its extended header or metadata") from None


def encode(kind: str, name: str, time_s: float, content: bytes) -> bytes:
    """Bytes of a message with a header of version 1.

    Raises
    ------
    DeviceInputError
        Where the name does not fit its 20 bytes: cut names would be confused with one another.
    """
    encoded = name.encode("utf-8")
    if len(encoded) > _NAME_BYTES:
        raise DeviceInputError(
            f"{name!r}: an OpenIGTLink name has at most {_NAME_BYTES} bytes, this one {len(encoded)}"
        )
    seconds = int(time_s)
    fraction = min(0xFFFFFFFF, int((time_s - seconds) * 2**32))
    kind_bytes = kind.encode("ascii")
    return _HEADER.pack(1, kind_bytes, encoded, seconds, fraction, len(content), crc64(content)) + content


def _column_major(T: ArrayLike, name: str) -> list[float]:
    matrix = np.asarray(T, dtype=np.float64)
    if not is_rigid(matrix):
        raise DeviceInputError(f"{name}: no rigid, finite 4 × 4 pose; a tool without a pose is sent as STATUS")
    return [float(value) for value in matrix[:3].T.ravel()]


def encode_transform(name: str, time_s: float, T: ArrayLike) -> bytes:
    """Bytes of a TRANSFORM message; a matrix that is not rigid and finite is refused."""
    return encode("TRANSFORM", name, time_s, struct.pack(">12f", *_column_major(T, name)))


def encode_transforms(name: str, time_s: float, poses: Mapping[str, ArrayLike]) -> bytes:
    """Bytes of a TDATA message: many tools at one moment."""
    items = []
    for tool, T in poses.items():
        encoded = tool.encode("utf-8")
        if len(encoded) > _NAME_BYTES:
            raise DeviceInputError(f"{tool!r}: an OpenIGTLink name has at most {_NAME_BYTES} bytes")
        items.append(_TDATA_ITEM.pack(encoded, 2, 0, *_column_major(T, tool)))  # 2: 6-D tracker
    return encode("TDATA", name, time_s, b"".join(items))


def encode_position(name: str, time_s: float, T: ArrayLike) -> bytes:
    """Return a POSITION message: a (4, 4) pose, mm, as position and quaternion x y z w."""
    pose = np.asarray(T, dtype=np.float64)
    _column_major(pose, name)  # refuses what is no finite pose
    w, x, y, z = quaternion_from_rotation(pose[:3, :3])
    return encode("POSITION", name, time_s, struct.pack(">7f", *pose[:3, 3], x, y, z, w))


def encode_status(name: str, time_s: float, status: Status) -> bytes:
    """Bytes of a STATUS message."""
    head = struct.pack(">Hq20s", status.code, status.subcode, status.error_name.encode("ascii")[:20])
    return encode("STATUS", name, time_s, head + status.text.encode("ascii", "replace") + b"\0")


def decode_status(content: bytes) -> Status:
    """Content of a STATUS message."""
    if len(content) < 30:
        raise ProtocolError(f"STATUS of {len(content)} bytes, at least 30 expected")
    code, subcode, name = struct.unpack_from(">Hq20s", content)
    return Status(code, subcode, _text(name), _text(content[30:]))


def _matrix(values: tuple[float, ...]) -> Array:
    a, d, g, b, e, h, c, f, i, x, y, z = values  # column by column
    return np.array(((a, b, c, x), (d, e, f, y), (g, h, i, z), (0.0, 0.0, 0.0, 1.0)))


def decode_poses(message: Message) -> dict[str, Array]:
    """Poses of a TRANSFORM, TDATA or POSITION message as sent: (4, 4) mm by tool name, finite or not.

    A POSITION without orientation has NaN for its rotation: a position alone is no pose.

    Raises
    ------
    ProtocolError
        Where the content has not the size that the kind prescribes, or the kind holds no poses.
    """
    content, size = message.content, len(message.content)
    if message.kind == "TRANSFORM" and size == 48:
        return {message.name: _matrix(struct.unpack(">12f", content))}
    if message.kind == "TDATA" and size % _TDATA_ITEM.size == 0:
        items = [_TDATA_ITEM.unpack_from(content, at) for at in range(0, size, _TDATA_ITEM.size)]
        return {_text(name): _matrix(tuple(values)) for name, _, _, *values in items}
    if message.kind in ("POSITION", "QTRANS") and size in (12, 24, 28):
        return {message.name: _position(content)}
    raise ProtocolError(f"{message.kind} from {message.name!r}: {size} bytes are no poses")


def _position(content: bytes) -> Array:
    x, y, z, *rest = struct.unpack(f">{len(content) // 4}f", content)
    quaternion = [float("nan")] * 4
    if len(rest) == 4:
        quaternion = [rest[3], *rest[:3]]  # sent as x y z w
    elif len(rest) == 3:  # w left out, ≥ 0
        quaternion = [max(0.0, 1.0 - sum(q * q for q in rest)) ** 0.5, *rest]
    length = sum(q * q for q in quaternion) ** 0.5
    if not abs(length - 1.0) < 0.01:
        T = np.full((4, 4), np.nan)
        T[:3, 3], T[3] = (x, y, z), (0.0, 0.0, 0.0, 1.0)
        return T
    return pose_from_quaternion(quaternion, (x, y, z))
