"""Greedy choice of scale-field centres by orthogonal least squares, in blocks (DESIGN §3)."""

import math

import numpy as np
from numba import njit

BLOCK = 16
CHUNK = 256
FEWEST_ACTIVE = 512
ACTIVE_SHARE = 8


@njit(cache=True, nogil=True)
def begin(starts, rows, values, scale, target, ridge):
    """Return what a selection starts from, nothing chosen: the normal matrix's diagonal, and pulls, of each atom.

    starts, rows, values: columns of A, compressed. scale, target: (n,). ridge: (columns,), in units of the normal
    matrix's mean diagonal. Returned: (columns,) diagonal without and with the ridge; pull Σ scale A target; which
    atoms may be chosen.
    """
    diagonal, pull = _diagonal_and_pull(starts, rows, values, scale, target)
    mean = diagonal.sum() / max((diagonal > 0.0).sum(), 1)
    return diagonal, diagonal + ridge * mean, pull, diagonal > 1e-6 * ridge * mean


@njit(cache=True, nogil=True)
def extend(
    pointer,
    index,
    value,
    starts,
    rows,
    values,
    scale,
    diagonal,
    full,
    usable,
    rest,
    pull,
    basis,
    chosen,
    gains,
    right,
    done,
    held,
):
    """Choose atoms until `chosen` is full, each the one that lowers Σ (scale_i (A w)_i − target_i)² + Σ ridge w² most.

    Pivoted Cholesky of the normal equations, whose columns are formed only for the atoms chosen. It is held in single
    precision, which chooses the same atoms in a third of the time; the weights are solved again in double. Atoms are
    chosen in blocks of 1 … 16 among the most promising; the others are brought up to date once a block, in one pass
    over what is chosen (a block ends early where one of them may be better than what is left).

    pointer, index, value: rows of A, compressed; then its columns. scale, diagonal, full, usable: as given to and
    returned by `begin`. rest, pull: (columns,) diagonal and pulls less what the atoms chosen so far explain; at first
    `full` and what `begin` returned; changed here. basis: (k, columns) float32, chosen, gains, right: (k,), the first
    `done` of them filled. held: atoms that are chosen before any other, in this order.
    Returns how many are chosen; fewer than k where nothing more is gained.
    """
    count, columns = basis.shape
    place = np.full(columns, -1, np.int64)
    normal = np.empty((BLOCK, columns), np.float32)
    column = np.empty(columns)
    while done < count:
        gain = _gains(pull, rest, full, usable)
        active, least = _active(gain, held[done : done + BLOCK])
        place[active] = np.arange(active.shape[0])
        near = np.empty((done + BLOCK, active.shape[0]), np.float32)
        for s in range(done):
            for a in range(active.shape[0]):
                near[s, a] = basis[s, active[a]]
        begun = done
        block = BLOCK if done < held.shape[0] else min(BLOCK, 1 + done // 4)
        while done < min(begun + block, count):
            best, best_gain = _best(pull, rest, full, usable, active)
            if done < held.shape[0]:
                best = held[done]
                rest[best] = max(rest[best], 1e-6 * full[best])
                best_gain = pull[best] * pull[best] / rest[best]
            elif best < 0 or (best_gain < least and done > begun):
                break
            _normal_column(pointer, index, value, scale, starts, rows, values, best, column)
            column[best] += full[best] - diagonal[best]
            normal[done - begun] = column
            pivot = math.sqrt(rest[best])
            y = pull[best] / pivot
            _choose(near, done, place[best], column, active, pivot, y, rest, pull)
            rest[best] = 0.0
            pull[best] = 0.0
            near[done, place[best]] = pivot
            chosen[done], gains[done], right[done] = best, best_gain, y
            done += 1
        if done == begun:
            break
        _bring_up(basis, normal, near, chosen, right, begun, done, place, rest, pull)
        place[active] = -1
    return done


@njit(cache=True, nogil=True)
def triangle_of(basis, chosen):
    """Return (k, k) the lower triangle L of the normal matrix of the k chosen atoms.

    With y = `right` of `extend`, L y = right side: the weights of the first m solve L[:m, :m]ᵀ w = y[:m].
    """
    count = chosen.shape[0]
    triangle = np.zeros((count, count))
    for a in range(count):
        for b in range(a + 1):
            triangle[a, b] = basis[b, chosen[a]]
    return triangle


@njit(cache=True, nogil=True)
def _diagonal_and_pull(starts, rows, values, scale, target):
    """Return (columns,) Σ (scale A)² and Σ scale A target of each atom."""
    columns = starts.shape[0] - 1
    diagonal = np.zeros(columns)
    pull = np.zeros(columns)
    for j in range(columns):
        for k in range(starts[j], starts[j + 1]):
            i = rows[k]
            a = values[k] * scale[i]
            diagonal[j] += a * a
            pull[j] += a * target[i]
    return diagonal, pull


@njit(cache=True, nogil=True)
def _gain(pull, rest, full):
    """Return by how much an atom lowers the sum of squares; 0 where it is nearly a sum of those chosen."""
    return pull * pull / rest if rest > 1e-3 * full else 0.0


@njit(cache=True, nogil=True)
def _gains(pull, rest, full, usable):
    """Return (columns,) the gain of each atom."""
    gain = np.zeros(pull.shape[0])
    for j in range(pull.shape[0]):
        if usable[j]:
            gain[j] = _gain(pull[j], rest[j], full[j])
    return gain


@njit(cache=True, nogil=True)
def _active(gain, held):
    """Return the atoms that a block looks at, ascending, and the least gain among them (0 where all are looked at)."""
    columns = gain.shape[0]
    wanted = max(columns // ACTIVE_SHARE, FEWEST_ACTIVE)
    least = 0.0
    if wanted < columns:
        least = np.partition(gain, columns - wanted)[columns - wanted]
    taken = gain >= least
    taken[held] = True
    return np.flatnonzero(taken), least


@njit(cache=True, nogil=True)
def _best(pull, rest, full, usable, active):
    """Return the active atom with the largest gain, and the gain; −1 where nothing is gained."""
    best, best_gain = -1, 0.0
    for j in active:
        if usable[j]:
            gain = _gain(pull[j], rest[j], full[j])
            if gain > best_gain:
                best, best_gain = j, gain
    return best, best_gain


@njit(cache=True, nogil=True)
def _normal_column(pointer, index, value, scale, starts, rows, values, atom, column):
    """Fill a column of the normal matrix, without the ridge."""
    column[:] = 0.0
    for k in range(starts[atom], starts[atom + 1]):
        i = rows[k]
        a = values[k] * scale[i] * scale[i]
        if a == 0.0:
            continue
        for m in range(pointer[i], pointer[i + 1]):
            column[index[m]] += a * value[m]


@njit(cache=True, nogil=True, fastmath={"contract"})
def _choose(near, done, at, column, active, pivot, y, rest, pull):
    """Bring the active atoms up to date for a chosen one, the active atom number `at`."""
    size = active.shape[0]
    own = near[done]
    for a in range(size):
        own[a] = column[active[a]]
    for s in range(done):
        factor = near[s, at]
        line = near[s]
        for a in range(size):
            own[a] -= factor * line[a]
    for a in range(size):
        entry = own[a] / pivot
        own[a] = entry
        j = active[a]
        rest[j] -= entry * entry
        pull[j] -= entry * y


@njit(cache=True, nogil=True, fastmath={"contract"})
def _bring_up(basis, normal, near, chosen, right, begun, done, place, rest, pull):
    """Bring the atoms that were not active up to date for a block of chosen ones, chunk by chunk."""
    size = done - begun
    columns = basis.shape[1]
    factors = np.empty((size, done), np.float32)
    for t in range(size):
        for s in range(done):
            factors[t, s] = near[s, place[chosen[begun + t]]]
    sums = np.empty((BLOCK, CHUNK), np.float32)
    for low in range(0, columns, CHUNK):
        width = min(CHUNK, columns - low)
        for t in range(size):
            sums[t, :width] = normal[t, low : low + width]
        for s in range(0, begun - 3, 4):
            first, second = basis[s, low : low + width], basis[s + 1, low : low + width]
            third, fourth = basis[s + 2, low : low + width], basis[s + 3, low : low + width]
            for t in range(size):
                a, b, f, g = factors[t, s], factors[t, s + 1], factors[t, s + 2], factors[t, s + 3]
                total = sums[t]
                for c in range(width):
                    total[c] -= a * first[c] + b * second[c] + f * third[c] + g * fourth[c]
        for s in range(begun - begun % 4, begun):
            line = basis[s, low : low + width]
            for t in range(size):
                factor = factors[t, s]
                total = sums[t]
                for c in range(width):
                    total[c] -= factor * line[c]
        for t in range(size):
            total = sums[t]
            for s in range(t):
                factor = factors[t, begun + s]
                line = sums[s]
                for c in range(width):
                    total[c] -= factor * line[c]
            pivot = factors[t, begun + t]
            y = right[begun + t]
            for c in range(width):
                entry = total[c] / pivot
                total[c] = entry
                j = low + c
                if place[j] < 0:
                    rest[j] -= entry * entry
                    pull[j] -= entry * y
            basis[begun + t, low : low + width] = total[:width]
    for t in range(size):
        for a in range(t):
            basis[begun + t, chosen[begun + a]] = 0.0
        basis[begun + t, chosen[begun + t]] = factors[t, begun + t]
