"""The .hhsr file: an organ in a few kilobytes, without loss, without pickle, without a timestamp.

    bytes 0–3   b"HHSR"
    byte  4     version of the format, 1
    bytes 5–8   CRC-32 (little-endian) of all that follows
    varint      length of the body
    body        provenance (`header`), then the tree (`tree`), both out of `blocks`

Equal shapes give equal bytes. Every number comes back bit for bit, in whatever form the file found to be the smallest.
"""

from __future__ import annotations

import zlib

from hhsr.errors import FileFormatError, InputError
from hhsr.io.blocks import Reader, Writer
from hhsr.io.header import read_provenance, write_provenance
from hhsr.io.tree import read_tree, write_tree
from hhsr.io.validity import require_valid
from hhsr.model import Provenance, Tree

MAGIC = b"HHSR"
VERSION = 1
_START = len(MAGIC) + 1 + 4

__all__ = ["VERSION", "decode", "encode"]


def encode(tree: Tree, provenance: Provenance) -> bytes:
    """Return a shape as the bytes of a .hhsr file; InputError where it is not valid (`hhsr.io.validity`)."""
    require_valid(tree, InputError)
    body = Writer()
    write_provenance(body, provenance)
    write_tree(body, tree)
    framed = Writer()
    framed.sized(body.written())
    return MAGIC + bytes([VERSION]) + zlib.crc32(framed.written()).to_bytes(4, "little") + framed.written()


def decode(data: bytes) -> tuple[Tree, Provenance]:
    """Return the tree and the provenance of a .hhsr file's bytes, every number as it was written.

    Raises FileFormatError, which says what is wrong, on bytes that are foreign, cut short, damaged, written by newer
    software, or that hold no valid tree.
    """
    if data[:4] != MAGIC:
        raise FileFormatError(f"not a .hhsr file: it starts with {bytes(data[:4])!r}, expected {MAGIC!r}")
    if len(data) > 4 and data[4] != VERSION:
        raise FileFormatError(
            f"the file is of format version {data[4]}, this software reads version {VERSION}: update hhsr to open it"
        )
    if len(data) <= _START:
        raise FileFormatError(f"the file is cut short: {len(data)} bytes, expected more than {_START}")
    reader = Reader(data[_START:])
    size = reader.varint()
    if reader.left != size:
        raise FileFormatError(f"the file is cut short or goes on too long: {reader.left} bytes, expected {size}")
    checksum = zlib.crc32(data[_START:])
    if checksum != int.from_bytes(data[5:_START], "little"):
        raise FileFormatError("the file is damaged: its checksum does not fit; fetch or fit it again")
    provenance = read_provenance(reader)
    tree = read_tree(reader)
    if reader.left:
        raise FileFormatError(f"{reader.left} bytes follow the tree, expected none")
    require_valid(tree, FileFormatError)
    return tree, provenance
