"""Vectors of numbers in formulas, for kernels that a compiler finds none in: each operation emits one instruction.

Used while numba compiles an intrinsic. A vector of doubles, integers or truths; a plain number in a formula stands for
all lanes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload

LANES = 8  # of a vector, where nothing else is said
DOUBLE, FLOAT, LONG, INT, SHORT = ir.DoubleType(), ir.FloatType(), ir.IntType(64), ir.IntType(32), ir.IntType(16)


def _wide(element: Any, lanes: int = LANES) -> Any:
    return ir.VectorType(element, lanes)


class Vector:
    """Some values, one a lane, while code is emitted by a builder of LLVM's."""

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder, self.value = builder, value
        self.lanes = value.type.count
        self.floats = isinstance(value.type.element, (ir.DoubleType, ir.FloatType))

    @classmethod
    def of(cls, builder: Any, element: Any, lanes: int = LANES) -> Vector:
        """Return one value of the emitted code in all lanes."""
        none = ir.Constant(_wide(element.type, lanes), ir.Undefined)
        first = builder.insert_element(none, element, ir.Constant(INT, 0))
        return cls(builder, builder.shuffle_vector(first, none, ir.Constant(_wide(INT, lanes), [0] * lanes)))

    def _right(self, other: Vector | float) -> Any:
        return other.value if isinstance(other, Vector) else ir.Constant(self.value.type, [other] * self.lanes)

    def _emit(self, name: str, other: Vector | float) -> Vector:
        return Vector(self.builder, getattr(self.builder, name)(self.value, self._right(other)))

    def __add__(self, other: Vector | float) -> Vector:
        return self._emit("fadd" if self.floats else "add", other)

    def __sub__(self, other: Vector | float) -> Vector:
        return self._emit("fsub" if self.floats else "sub", other)

    def __mul__(self, other: Vector | float) -> Vector:
        return self._emit("fmul" if self.floats else "mul", other)

    def __truediv__(self, other: Vector | float) -> Vector:
        return self._emit("fdiv", other)

    def __and__(self, other: Vector | int) -> Vector:
        return self._emit("and_", other)

    def __or__(self, other: Vector | int) -> Vector:
        return self._emit("or_", other)

    def __xor__(self, other: Vector | int) -> Vector:
        return self._emit("xor", other)

    def __lshift__(self, bits: Vector | int) -> Vector:
        return self._emit("shl", bits)

    def __rshift__(self, bits: Vector | int) -> Vector:
        return self._emit("lshr", bits)

    def __invert__(self) -> Vector:
        """Return the other truth."""
        return Vector(self.builder, self.builder.not_(self.value))

    def __abs__(self) -> Vector:
        """Return the sizes of doubles or floats."""
        kind = self.value.type
        return Vector(
            self.builder,
            self.builder.call(_intrinsic(self.builder, f"llvm.fabs.{_name(self)}", kind, [kind]), [self.value]),
        )

    def _compare(self, sign: str, other: Vector | float) -> Vector:
        compare = self.builder.fcmp_ordered if self.floats else self.builder.icmp_signed
        return Vector(self.builder, compare(sign, self.value, self._right(other)))

    def __lt__(self, other: Vector | float) -> Vector:
        return self._compare("<", other)

    def __le__(self, other: Vector | float) -> Vector:
        return self._compare("<=", other)

    def __gt__(self, other: Vector | float) -> Vector:
        return self._compare(">", other)

    def __ge__(self, other: Vector | float) -> Vector:
        return self._compare(">=", other)

    def is_(self, other: Vector | float) -> Vector:
        """Return where two are equal; false where one is not a number."""
        return self._compare("==", other)

    def where(self, yes: Vector, no: Vector | float) -> Vector:
        """Return, of truths, `yes` in the lanes that are true and `no` in the others."""
        return Vector(self.builder, self.builder.select(self.value, yes.value, yes._right(no)))

    def least(self, other: Vector | float) -> Vector:
        return (self < other).where(self, other)

    def most(self, other: Vector | float) -> Vector:
        return (self > other).where(self, other)

    def doubles(self) -> Vector:
        """Return integers, floats or truths (0 and 1) as doubles."""
        kind = _wide(DOUBLE, self.lanes)
        if self.floats:
            return Vector(self.builder, self.builder.fpext(self.value, kind))
        truths = self.value.type.element.width == 1
        return Vector(self.builder, (self.builder.uitofp if truths else self.builder.sitofp)(self.value, kind))

    def wide(self) -> Vector:
        """Return 16-bit integers as 32-bit ones."""
        return Vector(self.builder, self.builder.sext(self.value, _wide(INT, self.lanes)))

    def halves(self) -> tuple[Vector, Vector]:
        """Return the lower and the upper 16 bits of integers, as integers with a sign."""
        lower, upper = (
            Vector(self.builder, self.builder.ashr(half, self._right(16))) for half in ((self << 16).value, self.value)
        )
        return lower, upper

    def some(self, first: int, lanes: int) -> Vector:
        """Return so many lanes from a first one on."""
        places = ir.Constant(_wide(INT, lanes), list(range(first, first + lanes)))
        return Vector(self.builder, self.builder.shuffle_vector(self.value, self.value, places))

    def integers(self) -> Vector:
        """Return doubles as integers, towards 0."""
        return Vector(self.builder, self.builder.fptosi(self.value, _wide(INT, self.lanes)))

    def longs(self) -> Vector:
        """Return doubles as 64-bit integers, towards 0."""
        return Vector(self.builder, self.builder.fptosi(self.value, _wide(LONG, self.lanes)))

    def bits(self) -> Any:
        """Return truths as one 64-bit integer, lane 0 the lowest bit."""
        packed = self.builder.bitcast(self.value, ir.IntType(self.lanes))
        return self.builder.zext(packed, LONG)


def fused(factor: Vector, other: Vector | float, more: Vector | float) -> Vector:
    """Return factor·other + more of doubles or floats, rounded once."""
    kind = factor.value.type
    function = _intrinsic(factor.builder, f"llvm.fma.{_name(factor)}", kind, [kind] * 3)
    return Vector(
        factor.builder, factor.builder.call(function, [factor.value, factor._right(other), factor._right(more)])
    )


def root(number: Vector) -> Vector:
    """Return the square root of doubles or floats, correctly rounded."""
    kind = number.value.type
    return Vector(
        number.builder,
        number.builder.call(_intrinsic(number.builder, f"llvm.sqrt.{_name(number)}", kind, [kind]), [number.value]),
    )


def totals(numbers: Sequence[Vector]) -> list[Any]:
    """Return the sum of all lanes of each of some vectors of doubles, no more than they have lanes.

    Lanes are halved two vectors at a time, so that in the end all sums stand in one.
    """
    builder, width = numbers[0].builder, numbers[0].lanes
    rows, owners = [number.value for number in numbers], [[k] for k in range(len(numbers))]
    while width > 1:
        width //= 2
        if len(rows) > 1 and len(rows) % 2 == 1:
            rows, owners = [*rows, rows[-1]], [*owners, [-1] * len(owners[-1])]
        sides, lanes = min(len(rows), 2), rows[0].type.count
        parts = [(part, side) for part in range(lanes // (2 * width)) for side in range(sides)]
        lower = [side * lanes + 2 * width * part + lane for part, side in parts for lane in range(width)]
        halves = [ir.Constant(_wide(INT, len(lower)), [lane + upper for lane in lower]) for upper in (0, width)]
        pairs = range(0, len(rows), sides)
        owners = [[owners[k + side][part] for part, side in parts] for k in pairs]
        rows = [
            builder.fadd(*(builder.shuffle_vector(rows[k], rows[k + sides - 1], half) for half in halves))
            for k in pairs
        ]
    places = [owners[0].index(k) for k in range(len(numbers))]
    return [builder.extract_element(rows[0], ir.Constant(INT, place)) for place in places]


def _name(numbers: Vector) -> str:
    """Return how LLVM's functions call vectors of these doubles or floats."""
    return f"v{numbers.lanes}f{64 if numbers.value.type.element == DOUBLE else 32}"


def _intrinsic(builder: Any, name: str, result: Any, kinds: list[Any]) -> Any:
    """Return a function that LLVM knows by its name."""
    return builder.module.globals.get(name) or ir.Function(builder.module, ir.FunctionType(result, kinds), name)


def load(builder: Any, table: Any, first: int, lanes: int = LANES) -> Vector:
    """Return so many numbers in a row from a number of elements on."""
    at = builder.gep(table, [ir.Constant(LONG, first)])
    return Vector(builder, builder.load(builder.bitcast(at, _wide(table.type.pointee, lanes).as_pointer()), align=8))


def store(builder: Any, vector: Vector, table: Any, first: int) -> None:
    """Put a vector's numbers into a table from a number of elements on."""
    at = builder.gep(table, [ir.Constant(LONG, first)])
    builder.store(vector.value, builder.bitcast(at, vector.value.type.as_pointer()), align=8)


def _lane(builder: Any, table: Any, index: Vector, k: int) -> Any:
    """Return where lane k's element of a table lies; no index is negative."""
    place = builder.extract_element(index.value, ir.Constant(INT, k))
    return builder.gep(table, [builder.zext(place, LONG)])


def gather(builder: Any, table: Any, index: Vector) -> Vector:
    """Return the table's element at each lane's index."""
    value = ir.Constant(_wide(table.type.pointee, index.lanes), ir.Undefined)
    for k in range(index.lanes):
        value = builder.insert_element(value, builder.load(_lane(builder, table, index, k)), ir.Constant(INT, k))
    return Vector(builder, value)


def gather_rows(builder: Any, table: Any, index: Vector, size: int) -> list[Vector]:
    """Return the `size` (a power of two) elements from each lane's index on, as so many vectors."""
    row = _wide(table.type.pointee, size).as_pointer()
    rows = [builder.load(builder.bitcast(_lane(builder, table, index, k), row), align=4) for k in range(index.lanes)]
    wide = size
    while len(rows) > 1:
        wide *= 2
        both = ir.Constant(_wide(INT, wide), list(range(wide)))
        rows = [builder.shuffle_vector(rows[k], rows[k + 1], both) for k in range(0, len(rows), 2)]
    columns = ([size * k + c for k in range(index.lanes)] for c in range(size))
    return [
        Vector(builder, builder.shuffle_vector(rows[0], rows[0], ir.Constant(_wide(INT, index.lanes), column)))
        for column in columns
    ]


def gather_columns(builder: Any, table: Any, index: Vector) -> list[Vector]:
    """Return the elements from each lane's index on, one vector for each place: as many as there are lanes, a power of
    two."""
    row = _wide(table.type.pointee, index.lanes).as_pointer()
    rows = [builder.load(builder.bitcast(_lane(builder, table, index, k), row), align=4) for k in range(index.lanes)]
    step = 1
    while step < index.lanes:  # squares of `step` beside the diagonal change places
        places = range(index.lanes)
        lower = ir.Constant(_wide(INT, index.lanes), [c if c & step == 0 else index.lanes + c - step for c in places])
        upper = ir.Constant(_wide(INT, index.lanes), [c + step if c & step == 0 else index.lanes + c for c in places])
        for k in places:
            if k & step == 0:
                one, other = rows[k], rows[k + step]
                rows[k] = builder.shuffle_vector(one, other, lower)
                rows[k + step] = builder.shuffle_vector(one, other, upper)
        step *= 2
    return [Vector(builder, row) for row in rows]


def fetch_ahead(builder: Any, table: Any, index: Vector) -> None:
    """Ask for the table's elements at each lane's index, to be near when they are read: no read waits for them."""
    for k in range(index.lanes):
        _fetch(builder, _lane(builder, table, index, k))


def _fetch(builder: Any, place: Any) -> None:
    byte = ir.IntType(8).as_pointer()
    function = _intrinsic(builder, "llvm.prefetch.p0", ir.VoidType(), [byte, INT, INT, INT])
    hints = [ir.Constant(INT, hint) for hint in (0, 3, 1)]
    builder.call(function, [builder.bitcast(place, byte), *hints])


def ask_ahead(table: Any, index: Any) -> None:
    """Ask for an element of an array, to be near when it is read: nothing waits for it. Without JIT: do nothing."""


@intrinsic
def _ask_ahead(typing: Any, table: Any, index: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        _fetch(builder, builder.gep(array.data, [arguments[1]]))
        return context.get_dummy_value()

    return types.void(table, types.int64), emit


@overload(ask_ahead, inline="always")
def _compiled_ask_ahead(table, index):
    return lambda table, index: _ask_ahead(table, index)


@intrinsic
def bits_set(typing: Any, number: Any) -> Any:
    """Return how many bits of a number are set."""
    return types.int64(types.int64), lambda context, builder, signature, arguments: builder.ctpop(arguments[0])


def lowest_bit(number: Any) -> Any:
    """Return which bit of a number that is not 0 is the lowest that is set."""
    return int(number & -number).bit_length() - 1


@intrinsic
def _lowest_bit(typing: Any, number: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), emit


@overload(lowest_bit, inline="always")
def _compiled_lowest_bit(number):
    return lambda number: _lowest_bit(number)
