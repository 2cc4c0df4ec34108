"""The provenance of a shape to bytes and back: hash, errors as a block, and the rest as deflated JSON."""

from __future__ import annotations

import json
import zlib
from typing import Any

import numpy as np

from hhsr.errors import FileFormatError, InputError
from hhsr.io.blocks import Reader, Writer
from hhsr.model import ErrorFigures, Provenance

# Part of version 1 of the file format: words that deflate need not spell out. Only a new version may change them.
_WORDS = (
    b'"genus":"bodies":"seed":0,"cuts":[{"d":0.0,"lobes":1,"step_area_mm2":"largest_step_mm":"depth":0,"topology":{'
    b'"recipe":"paper","recipe":"default","retain":true,"retain":false,"t_mm":5.0,"t1":0.05,"t2_mm3":0.0,"t3_mm":7.0,'
    b'"volume_ml":"source_volume_ml":"extent_mm":"max_parameters":null,"max_error_mm":null,"max_mean_error_mm":null,'
    b'{"kind":"retained","vertices":,"faces":}{"half_width_mm":0.0,"lobes":1,"step_area_mm2":0.0,"largest_step_mm":'
    b'"bodies":[1,1],"genus":[0,0],"leaves":[{"kind":"model","parameters":'
    b'{"frame":"RAS","label":1,"options":{"max_parameters":320},"report":{"cuts":[],"topology":{"bodies":[1,1],"genus":'
    b'[0,0],"volume_ml":["leaves":[{"kind":"model","parameters":"software":"hhsr-guidance 0.1.0"}'
    b'{"frame":"LSA","label":null,"options":{},{"frame":"LPS","label":null,"options":{"max_parameters":'
)
_MAX_HEADER = 1 << 20
_HASH_SIZE = 32
_NO_HASH, _SHA256, _OTHER_HASH = range(3)


def write_provenance(writer: Writer, provenance: Provenance) -> None:
    """Append a provenance; InputError where it holds what JSON cannot say."""
    try:
        digest = bytes.fromhex(provenance.source_hash)
    except ValueError:
        digest = b""
    if not provenance.source_hash:
        writer.varint(_NO_HASH)
    elif len(digest) == _HASH_SIZE and digest.hex() == provenance.source_hash:
        writer.varint(_SHA256)
        writer.raw(digest)
    else:
        writer.varint(_OTHER_HASH)
        writer.sized(provenance.source_hash.encode(errors="surrogatepass"))
    errors = [] if provenance.fit_error is None else [provenance.fit_error]
    writer.varint(len(errors))
    writer.varint(len(provenance.leaf_errors))
    figures = np.array([*errors, *provenance.leaf_errors], dtype=np.float64)
    if not np.isfinite(figures).all():
        raise InputError("the shape's error figures are not finite; measure them before writing the file")
    writer.floats(figures)
    writer.sized(_deflated(provenance))


def _deflated(provenance: Provenance) -> bytes:
    words = {
        "frame": provenance.frame,
        "label": provenance.label,
        "options": dict(provenance.options),
        "report": dict(provenance.report),
        "software": provenance.software,
    }
    try:
        text = json.dumps(words, separators=(",", ":"), allow_nan=False, default=_plain).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"options and report must hold JSON values only: {error}") from error
    if len(text) > _MAX_HEADER:
        raise InputError(f"options and report take {len(text)} bytes as JSON, expected at most {_MAX_HEADER}")
    deflate = zlib.compressobj(9, zlib.DEFLATED, -15, 9, zlib.Z_DEFAULT_STRATEGY, _WORDS)
    return deflate.compress(text) + deflate.flush()


def _plain(value: Any) -> Any:
    """Return numpy's scalars and arrays as Python's own numbers and lists."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is no JSON value")


def read_provenance(reader: Reader) -> Provenance:
    """Return the provenance that `write_provenance` wrote; FileFormatError where the bytes make none."""
    kind = reader.varint()
    if kind == _SHA256:
        source_hash = reader.raw(_HASH_SIZE).hex()
    elif kind == _OTHER_HASH:
        try:
            source_hash = reader.sized().decode(errors="surrogatepass")
        except UnicodeDecodeError as error:
            raise FileFormatError(f"the source's hash is not text: {error}") from error
    elif kind == _NO_HASH:
        source_hash = ""
    else:
        raise FileFormatError(f"the source's hash is of kind {kind}, expected 0 to {_OTHER_HASH}")
    whole, parts = reader.varint(), reader.varint()
    if whole > 1:
        raise FileFormatError(f"the file has {whole} error figures of the whole, expected at most one")
    rows = reader.floats(3 * (whole + parts)).reshape(-1, 3)
    if not np.isfinite(rows).all():
        raise FileFormatError("the file's error figures are not finite")
    figures = [ErrorFigures(*row) for row in rows.tolist()]
    words = _inflated(reader.sized())
    return Provenance(
        source_hash=source_hash,
        frame=_typed(words, "frame", str),
        label=_typed(words, "label", int | None),
        options=_typed(words, "options", dict),
        software=_typed(words, "software", str),
        fit_error=figures[0] if whole else None,
        leaf_errors=tuple(figures[whole:]),
        report=_typed(words, "report", dict),
    )


def _inflated(data: bytes) -> dict[str, Any]:
    inflate = zlib.decompressobj(-15, _WORDS)
    try:
        text = inflate.decompress(data, _MAX_HEADER)
        if not inflate.eof or inflate.unused_data:
            raise FileFormatError("the file's header does not end where it should")
        words = json.loads(text)
    except (zlib.error, ValueError, RecursionError) as error:
        if isinstance(error, FileFormatError):
            raise
        raise FileFormatError(f"the file's header cannot be read: {error}") from error
    if not isinstance(words, dict):
        raise FileFormatError(f"the file's header is a {type(words).__name__}, expected an object")
    return words


def _typed(words: dict[str, Any], name: str, kind: Any) -> Any:
    value = words.get(name)
    if not isinstance(value, kind) or isinstance(value, bool):
        raise FileFormatError(f"the header's {name} is {value!r}, expected {kind}")
    return value
