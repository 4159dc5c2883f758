"""Pieces of surface, and how a ghost leaves as one.

A piece is a stretch of stripe without a jump in range, together with what lies beside it in the scans just before. What a scanner
looks at hangs together for many scans; a reflection, or a stray line taken for the stripe, is a small piece by itself. Rays of
later views are farther apart than points, so that few points of a ghost are ever contradicted one by one. Where a piece has lost
a share of its points, and no later visit has confirmed as many, the rest of it leaves too. A ghost contradicts the surface behind
it just as well: of two pieces that contradict each other, the smaller one is in doubt.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from vli_common.arrays import Float32Array, FloatArray, Int32Array, IntArray
from vli_mapping.allocation import Allocate, in_memory
from vli_mapping.entry import jumps
from vli_mapping.insertion import VISIT_SCANS, remove_one, squared_distance
from vli_mapping.spatial_hash import NONE, SpatialHash, bucket_of, cell_of, same_cell

_PARENT, _BROUGHT, _LEFT, _CONFIRMED = range(4)
"""Rows of the table of pieces: the piece it has become a part of, itself where none (Galler and Fisher, 1964); points that it
brought; of these, those that left because views contradicted them; points of later visits that merged into it."""
_MIN_PIECES = 1 << 10
_EVERY = 6
"""Of the points of a stripe look for what is beside them: a millimetre, as far as they look."""
_BESIDE_M = 1e-3
_BESIDE_SCANS = 3
_JUMP_M, _SLOPE = 5e-4, 7.0
"""Step across the ray, and the most along it for each across (82° of incidence), from which on a stripe is cut."""
_FEWEST_LEFT = 3
"""Contradicted points: fewer are an edge of something small."""
_MOST_POINTS = 10_000
"""Of a piece that leaves as one: ghosts are small, and what is large takes too long."""
_REACH_CELLS = 2
"""As far as the points of a piece lie apart."""


class Pieces:
    """Which piece each row of a map belongs to, and what became of the pieces.

    Only rows that came by ``join`` are of a piece: what was loaded, as the map of an earlier session is, neither gives evidence
    nor leaves by it. Memory: 4 bytes a row, and 16 bytes a piece, some 15 kB a minute.

    Args:
        capacity: rows of the map.
        allocate: where the number of each row's piece is kept.
    """

    def __init__(self, capacity: int, allocate: Allocate = in_memory) -> None:
        self._allocate = allocate
        self._of_row: Int32Array = allocate((capacity,), np.int32)
        self._of_row[:] = NONE
        self._table: Int32Array = np.zeros((4, _MIN_PIECES), np.int32)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def reserve(self, capacity: int) -> None:
        """Make room for ``capacity`` rows of the map."""
        grown = self._allocate((capacity,), np.int32)
        grown[: len(self._of_row)] = self._of_row
        grown[len(self._of_row) :] = NONE
        self._of_row = grown

    def join(
        self,
        grid: SpatialHash,
        columns: tuple[FloatArray, Int32Array],
        stripe: tuple[FloatArray, FloatArray, FloatArray, int],
        target: IntArray,
    ) -> None:
        """Give every row that a stripe has brought its piece, and take note of the pieces that it confirms.

        Args:
            grid: of the map.
            columns: position and scan of the map.
            stripe: points (N, 3) in map and, from the camera centre, the same; sigma (N,); number of the scan.
            target: (N,), what became of each point, −1 where nothing.
        """
        needed = self._count + len(target)
        if needed > self._table.shape[1]:
            grown = np.zeros((4, max(needed, 2 * self._table.shape[1])), np.int32)
            grown[:, : self._count] = self._table[:, : self._count]
            self._table = grown
        hashed = (grid.heads, grid.next, grid.cell_m)
        self._count = _join(hashed, columns, self._of_row, self._table, self._count, stripe, target)

    def leave(
        self,
        grid: SpatialHash,
        state: IntArray,
        columns: tuple[FloatArray, Float32Array, Int32Array],
        against: tuple[IntArray, FloatArray, int],
        share: float,
    ) -> int:
        """Count what has just left; let the rest of the pieces that lost too many points leave, and say how many do.

        Args:
            grid, state: of the map.
            columns: position, weight and scan of the map.
            against: rows (K,) that views contradict, some several times; points (K, 3) that were seen there instead; number of
                the scan. Rows that hold no point any more, and are not used again yet, have left.
            share: of the points of a piece, from which on the rest of it leaves.
        """
        return int(_leave(grid.heads, grid.next, grid.cell_m, state, columns, self._of_row, self._table, against, share))


@njit(cache=True, nogil=True)
def _join(grid, columns, of_row, table, count, stripe, target):  # type: ignore[no-untyped-def]
    """Cut a stripe where it jumps and join each run; return the number of pieces."""
    points, from_camera, sigma, number = stripe
    scan = columns[1]
    for row in target:
        # What the row held before has left.
        if row >= 0 and scan[row] == number:
            of_row[row] = NONE
    start = 0
    for stop in range(1, len(points) + 1):
        if stop < len(points) and not jumps(
            from_camera[stop - 1], from_camera[stop], sigma[stop - 1] + sigma[stop], _JUMP_M, _SLOPE
        ):
            continue
        count = _join_run(grid, columns, of_row, table, count, points[start:stop], number, target[start:stop])
        start = stop
    return count


@njit(cache=True, nogil=True)
def _join_run(grid, columns, of_row, table, count, points, number, target):  # type: ignore[no-untyped-def]
    """Make a run part of all pieces beside it, which so become one, else a new piece; return the number of pieces."""
    scan = columns[1]
    piece = np.int64(NONE)
    for index in range(0, len(points), _EVERY):
        row = _row_beside(grid, columns, of_row, points[index], number)
        if row >= 0:
            piece = _united(table, piece, _whole(table, of_row[row]))
    if piece < 0:
        piece = count
        table[:, piece] = 0
        table[_PARENT, piece] = piece
    for row in target:
        if row < 0:
            continue
        if scan[row] == number:
            if of_row[row] < 0:
                of_row[row] = piece
                table[_BROUGHT, piece] += 1
        elif of_row[row] >= 0 and number - scan[row] > VISIT_SCANS:
            table[_CONFIRMED, _whole(table, of_row[row])] += 1
    return count + 1 if piece == count and table[_BROUGHT, piece] > 0 else count


@njit(cache=True, nogil=True)
def _row_beside(grid, columns, of_row, p, number):  # type: ignore[no-untyped-def]
    """Return the row of a point beside ``p`` (3,) that a scan just before ``number`` brought; −1 where there is none."""
    heads, following, cell_m = grid
    position, scan = columns
    for i in range(cell_of(p[0] - _BESIDE_M, cell_m), cell_of(p[0] + _BESIDE_M, cell_m) + 1):
        for j in range(cell_of(p[1] - _BESIDE_M, cell_m), cell_of(p[1] + _BESIDE_M, cell_m) + 1):
            for k in range(cell_of(p[2] - _BESIDE_M, cell_m), cell_of(p[2] + _BESIDE_M, cell_m) + 1):
                at = np.int64(heads[bucket_of(i, j, k, len(heads))])
                while at >= 0:
                    if (
                        0 < number - scan[at] <= _BESIDE_SCANS
                        and of_row[at] >= 0
                        and squared_distance(position[at], p) <= _BESIDE_M * _BESIDE_M
                    ):
                        return at
                    at = np.int64(following[at])
    return np.int64(NONE)


@njit(cache=True, nogil=True)
def _whole(table, piece):  # type: ignore[no-untyped-def]
    """Return the piece that ``piece`` is a part of by now; halves the way there for the next who asks."""
    parent = table[_PARENT]
    at = np.int64(piece)
    while parent[at] != at:
        parent[at] = parent[parent[at]]
        at = np.int64(parent[at])
    return at


@njit(cache=True, nogil=True)
def _united(table, a, b):  # type: ignore[no-untyped-def]
    """Make two pieces, of which ``a`` may be none, one; return it."""
    if a < 0 or a == b:
        return b
    older, newer = min(a, b), max(a, b)
    table[_PARENT, newer] = older
    for figure in (_BROUGHT, _LEFT, _CONFIRMED):
        table[figure, older] += table[figure, newer]
    return older


@njit(cache=True, nogil=True)
def _leave(heads, following, cell_m, state, columns, of_row, table, against, share):  # type: ignore[no-untyped-def]
    """Count the rows that have left, then let the rest of the pieces that they make doubtful leave; return how many points do."""
    position, weight, scan = columns
    rows, seen, number = against
    lost = np.full(len(rows), NONE, np.int64)
    for index, row in enumerate(rows):
        if weight[row] > 0 or of_row[row] < 0:
            continue
        piece = _whole(table, of_row[row])
        instead = _row_beside((heads, following, cell_m), (position, scan), of_row, seen[index], number)
        if instead >= 0 and table[_BROUGHT, _whole(table, of_row[instead])] > table[_BROUGHT, piece]:
            table[_LEFT, piece] += 1
            lost[index] = piece
            of_row[row] = NONE
    count = 0
    if (lost < 0).all():
        return count
    stack = np.empty((_MOST_POINTS, 3), np.int64)
    for index, row in enumerate(rows):
        if lost[index] >= 0 and _is_ghost(table[:, lost[index]], share):
            p = position[row]
            stack[0] = cell_of(p[0], cell_m), cell_of(p[1], cell_m), cell_of(p[2], cell_m)
            count += _take_around(heads, following, cell_m, state, position, weight, of_row, table, lost[index], stack)
    return count


@njit(cache=True, nogil=True)
def _is_ghost(figures, share):  # type: ignore[no-untyped-def]
    """Return True where more of a piece has left than of a surface would, and than has been confirmed."""
    left = figures[_LEFT]
    return (
        left >= max(_FEWEST_LEFT, share * figures[_BROUGHT]) and left > figures[_CONFIRMED] and figures[_BROUGHT] <= _MOST_POINTS
    )


@njit(cache=True, nogil=True)
def _take_around(  # type: ignore[no-untyped-def]
    heads, following, cell_m, state, position, weight, of_row, table, piece, stack
):
    """Let the points of a piece leave, cell by cell from that at the foot of ``stack`` (S, 3) on; return how many do."""
    count, height = 0, 1
    reach = range(-_REACH_CELLS, _REACH_CELLS + 1)
    while height > 0:
        height -= 1
        i, j, k = stack[height]
        for di in reach:
            for dj in reach:
                for dk in reach:
                    cell = (i + di, j + dj, k + dk)
                    taken = _take_cell(heads, following, cell_m, state, position, weight, of_row, table, piece, cell)
                    if taken and height < len(stack):
                        stack[height] = cell
                        height += 1
                    count += taken
    return count


@njit(cache=True, nogil=True)
def _take_cell(heads, following, cell_m, state, position, weight, of_row, table, piece, cell):  # type: ignore[no-untyped-def]
    """Let the points of a piece in one cell leave; return how many do."""
    i, j, k = cell
    count = 0
    at = np.int64(heads[bucket_of(i, j, k, len(heads))])
    while at >= 0:
        after = np.int64(following[at])
        if of_row[at] >= 0 and same_cell(position[at], i, j, k, cell_m) and _whole(table, of_row[at]) == piece:
            remove_one(heads, following, cell_m, state, position, weight, at)
            count += 1
        at = after
    return count
