"""The .hhsr file: bit for bit back, never anything but FileFormatError on other bytes, and small."""

from __future__ import annotations

import math
import struct
import zlib
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hhsr.errors import FileFormatError, InputError
from hhsr.io import decode, encode
from hhsr.io.blocks import Reader, Writer, float_block
from hhsr.io.subset import rank_of_subset, subset_bytes, subset_of_rank
from hhsr.model import (
    CentreGrid,
    Contour,
    Cut,
    ErrorFigures,
    ModelLeaf,
    Node,
    Provenance,
    RetainedPart,
    ScaleField,
    Superquadric,
    Tree,
    frozen,
    subset_numbers,
)

ANY_FLOAT = st.floats(allow_nan=False, allow_infinity=False)
STEPPED = st.builds(lambda m, e: math.ldexp(m, e), st.integers(-(2**20), 2**20), st.integers(-30, 10))
NUMBER = ANY_FLOAT | STEPPED | st.floats(width=32, allow_nan=False, allow_infinity=False) | st.just(-0.0)
POSITIVE = st.floats(1e-3, 1e3) | st.integers(1, 4000).map(lambda m: m / 64)

TETRAHEDRON = frozen([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int64)


def arrays(values: st.SearchStrategy[float], *sizes: int) -> st.SearchStrategy[Any]:
    """Return frozen 1-D arrays of one of these sizes, sometimes all on one power-of-two grid as a fit stores them."""
    loose = st.sampled_from(sizes).flatmap(lambda n: st.lists(values, min_size=n, max_size=n))
    return loose.map(frozen)


@st.composite
def scale_fields(draw: st.DrawFn) -> ScaleField:
    sizes = tuple(draw(st.lists(st.integers(1, 40), max_size=3)))
    grid = CentreGrid(sizes, draw(POSITIVE))
    index = sorted(draw(st.sets(st.integers(0, grid.size - 1), max_size=12))) if grid.size else []
    return ScaleField(grid, frozen(index, np.int64), draw(arrays(NUMBER, len(index))))


MODELS = st.builds(
    ModelLeaf,
    arrays(NUMBER, 3),
    arrays(NUMBER, 0, 3),
    st.builds(Superquadric, arrays(POSITIVE, 6), arrays(NUMBER, 0, 1, 3, 5), arrays(NUMBER, 0, 1, 2, 3, 6)),
    scale_fields(),
)
RETAINED = st.just(RetainedPart(frozen(np.zeros((0, 3))), frozen(np.zeros((0, 3)), np.int64))) | arrays(NUMBER, 12).map(
    lambda values: RetainedPart(frozen(values.reshape(4, 3)), TETRAHEDRON)
)
CONTOURS = st.builds(
    Contour, arrays(NUMBER, 2), arrays(POSITIVE, 4), arrays(NUMBER, 0, 1, 3, 4), arrays(NUMBER, 0, 1, 7)
)
BANDS = st.tuples(st.just(0.0), st.just(())) | st.tuples(POSITIVE, st.lists(CONTOURS, max_size=3).map(tuple))


def cut_of(angles: Any, offset: float, band: tuple[float, tuple[Contour, ...]], left: Node, right: Node) -> Cut:
    return Cut(angles, offset, band[0], band[1], left, right)


NODES = st.recursive(
    MODELS | RETAINED, lambda nodes: st.builds(cut_of, arrays(NUMBER, 2), NUMBER, BANDS, nodes, nodes), max_leaves=6
)
TREES = st.builds(Tree, NODES, arrays(NUMBER, 6))
FIGURES = st.builds(ErrorFigures, ANY_FLOAT, ANY_FLOAT, ANY_FLOAT)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | ANY_FLOAT | st.text(),
    lambda values: st.lists(values, max_size=3) | st.dictionaries(st.text(), values, max_size=3),
    max_leaves=6,
)
PROVENANCES = st.builds(
    Provenance,
    source_hash=st.text() | st.binary(min_size=32, max_size=32).map(bytes.hex),
    frame=st.text(),
    label=st.none() | st.integers(),
    options=st.dictionaries(st.text(), JSON, max_size=3),
    software=st.text(),
    fit_error=st.none() | FIGURES,
    leaf_errors=st.lists(FIGURES, max_size=3).map(tuple),
    report=st.dictionaries(st.text(), JSON, max_size=3),
)


def fingerprint(value: Any) -> Any:
    """Return nested tuples of bytes that are equal where two records are equal bit for bit."""
    if isinstance(value, np.ndarray):
        return (value.dtype.str, value.shape, value.tobytes())
    if isinstance(value, float):
        return struct.pack("<d", value)
    if isinstance(value, tuple):
        return (type(value).__name__, *map(fingerprint, value))
    if hasattr(value, "__dataclass_fields__"):
        return (type(value).__name__, *(fingerprint(getattr(value, name)) for name in value.__dataclass_fields__))
    return value


def quantised_leaf(centres: int, seed: int = 0) -> ModelLeaf:
    """Return a leaf as a fit stores it: weights in 12 bits, lengths in 16."""
    rng = np.random.default_rng(seed)
    grid = CentreGrid((60, 160, 420, 1100), 2.5)
    index = np.sort(rng.choice(grid.size, centres, replace=False))
    weights = np.round(rng.normal(scale=0.03, size=centres) * 2**13) / 2**13
    axes = np.round(rng.uniform(20, 60, 6) * 64) / 64
    base = Superquadric(frozen(axes))
    return ModelLeaf(
        frozen(np.round(rng.normal(size=3) * 64) / 64),
        frozen([]),
        base,
        ScaleField(grid, frozen(index, np.int64), frozen(weights)),
    )


def prostate() -> tuple[Tree, Provenance]:
    rng = np.random.default_rng(1)
    tree = Tree(quantised_leaf(280), frozen(np.round(rng.normal(size=6) * 2**14) / 2**14))
    figures = ErrorFigures(37 / 2**10, 101 / 2**10, 300 / 2**10)
    return tree, Provenance("ab" * 32, "RAS", None, {"max_parameters": 320}, "0.1.0", figures, (figures,))


@given(TREES, PROVENANCES)
def test_every_bit_comes_back(tree: Tree, provenance: Provenance) -> None:
    data = encode(tree, provenance)
    read_tree, read_provenance = decode(data)
    assert fingerprint(read_tree) == fingerprint(tree)
    assert fingerprint(read_provenance) == fingerprint(provenance)
    assert encode(read_tree, read_provenance) == data
    assert read_tree.parameters == tree.parameters


@given(st.lists(NUMBER, min_size=1, max_size=40).map(np.array), st.integers(0, 3))
def test_a_block_of_floats_comes_back(values: np.ndarray, copies: int) -> None:
    values = np.concatenate([values] * (copies + 1))
    writer = Writer()
    writer.floats(values)
    assert len(writer.written()) <= 1 + 8 * values.size
    reader = Reader(writer.written())
    assert reader.floats(values.size).tobytes() == values.tobytes()
    assert reader.left == 0


@pytest.mark.parametrize(
    ("values", "most"),
    [
        (np.arange(1000) % 2 / 4, 2 + 125 + 1),  # one bit each
        (np.full(64, -0.0), 2 + 16),
        (np.ldexp(np.array([1.0, 3.0]), -1074), 4 + 1),  # denormals
        (np.array([2.0**31 + 1.0, 1.0]), 2 + 8),
        (np.array([2.0**40, 1.0]), 1 + 8),  # too far apart for integers of 32 bits: float32
        (np.array([math.pi]), 1 + 8),
    ],
)
def test_a_block_takes_the_smallest_form(values: np.ndarray, most: int) -> None:
    data = float_block(values)
    assert len(data) <= most
    assert Reader(data).floats(values.size).tobytes() == values.tobytes()


@given(st.integers(1, 300).flatmap(lambda n: st.tuples(st.just(n), st.sets(st.integers(0, n - 1)))))
def test_a_choice_of_centres_is_one_number_below_the_binomial(case: tuple[int, set[int]]) -> None:
    total, chosen = case
    index = np.array(sorted(chosen), dtype=np.int64)
    rank = rank_of_subset(index, total)
    assert rank == sum(math.comb(int(c), i + 1) for i, c in enumerate(index))
    assert 0 <= rank < math.comb(total, index.size)
    assert subset_of_rank(rank, total, index.size).tolist() == index.tolist()
    assert subset_bytes(total, index.size) <= 4 * subset_numbers(total, index.size)


def test_a_prostate_takes_hundreds_of_bytes() -> None:
    tree, provenance = prostate()
    assert tree.parameters <= 330
    assert len(encode(tree, provenance)) < 700


@given(st.data())
def test_damaged_bytes_raise_only_a_format_error(data: st.DataObject) -> None:
    whole = bytearray(encode(*prostate()))
    places = st.dictionaries(st.integers(0, len(whole) - 1), st.integers(1, 255), min_size=1, max_size=3)
    for at, change in data.draw(places).items():
        whole[at] ^= change
    with pytest.raises(FileFormatError):
        decode(bytes(whole))


def resealed(body: bytes) -> bytes:
    """Return a file with a right length and checksum around a body of any bytes."""
    framed = Writer()
    framed.sized(body)
    return b"HHSR\x01" + zlib.crc32(framed.written()).to_bytes(4, "little") + framed.written()


@given(TREES, PROVENANCES, st.data())
def test_a_forged_body_is_a_valid_tree_or_a_format_error(
    tree: Tree, provenance: Provenance, data: st.DataObject
) -> None:
    whole = encode(tree, provenance)
    size = Reader(whole[9:])
    body = bytearray(whole[-size.varint() :])
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(body) - 1))
        match data.draw(st.integers(0, 2)):
            case 0:
                body[at] = data.draw(st.integers(0, 255))
            case 1:
                del body[at:]
                body += b"\0"
            case _:
                body[at:at] = data.draw(st.binary(min_size=1, max_size=4))
    try:
        read = decode(resealed(bytes(body)))
    except FileFormatError:
        return
    encode(*read)  # what was let through is valid


@given(st.binary(max_size=200))
def test_foreign_bytes_raise_only_a_format_error(body: bytes) -> None:
    for data in (body, b"HHSR" + body, b"HHSR\x01" + body, resealed(body)):
        with pytest.raises(FileFormatError):
            decode(data)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda d: b"", "not a .hhsr file"),
        (lambda d: b"ply\nformat", "not a .hhsr file"),
        (lambda d: d[:4] + b"\x02" + d[5:], "version 2"),
        (lambda d: d[:7], "cut short"),
        (lambda d: d[:-1], "cut short"),
        (lambda d: d + b"\0", "goes on too long"),
        (lambda d: d[:-1] + bytes([d[-1] ^ 1]), "checksum"),
    ],
)
def test_the_message_says_what_is_wrong(change: Any, says: str) -> None:
    with pytest.raises(FileFormatError, match=says):
        decode(change(encode(*prostate())))


def leaf_with(**changes: Any) -> Tree:
    values: dict[str, Any] = {
        "centre": frozen([0, 0, 0]),
        "rotation": frozen([]),
        "superquadric": Superquadric(frozen(np.ones(6))),
        "scale_field": ScaleField.none(),
    }
    return Tree(ModelLeaf(**{**values, **changes}), frozen(np.zeros(6)))


GRID = CentreGrid((10,), 2.5)


@pytest.mark.parametrize(
    ("tree", "says"),
    [
        (leaf_with(centre=frozen([0, math.nan, 0])), "centre is not finite"),
        (leaf_with(rotation=frozen([1.0])), "rotation has shape"),
        (leaf_with(superquadric=Superquadric(frozen([1, 1, 1, 1, 1, 0]))), "must be > 0"),
        (leaf_with(superquadric=Superquadric(frozen(np.ones(6)), frozen([0, 0]))), "2 knots"),
        (leaf_with(scale_field=ScaleField(GRID, frozen([3, 3], np.int64), frozen([1, 1]))), "ascend"),
        (leaf_with(scale_field=ScaleField(GRID, frozen([10], np.int64), frozen([1]))), "ascend"),
        (leaf_with(scale_field=ScaleField(GRID, frozen([1], np.int64), frozen([1, 2]))), "weights|shape"),
        (leaf_with(scale_field=ScaleField(CentreGrid((0,), 2.5), frozen([], np.int64), frozen([]))), "grid"),
        (leaf_with(scale_field=ScaleField(CentreGrid((70000,), 2.5), frozen([], np.int64), frozen([]))), "at most"),
        (Tree(leaf_with().root, frozen([0, 0, 0, 0, 0, math.inf])), "pose"),
        (Tree(RetainedPart(frozen(np.eye(3)), frozen([[0, 1, 3]], np.int64)), frozen(np.zeros(6))), "names vertices"),
        (Tree(RetainedPart(frozen(np.eye(3)), frozen([[0, 1, 2]], np.int64)), frozen(np.zeros(6))), "not closed"),
    ],
)
def test_an_invalid_tree_is_not_written(tree: Tree, says: str) -> None:
    with pytest.raises(InputError, match=says):
        encode(tree, Provenance())


def test_too_deep_a_tree_is_not_written() -> None:
    node: Node = leaf_with().root
    for _ in range(13):
        node = Cut(frozen([0, 0]), 0.0, 0.0, (), node, leaf_with().root)
    with pytest.raises(InputError, match="deeper than 12"):
        encode(Tree(node, frozen(np.zeros(6))), Provenance())


@pytest.mark.parametrize("provenance", [Provenance(options={"x": math.nan}), Provenance(report={"x": object()})])
def test_what_json_cannot_say_is_not_written(provenance: Provenance) -> None:
    with pytest.raises(InputError, match="JSON"):
        encode(leaf_with(), provenance)
