"""Points by place: a chained hash of cubic cells whose cost does not depend on how many points there are.

A bucket holds the first of a chain of points, ``next`` the one after each. The low bits of a bucket are the cell's place in a
block of 4×4×4 cells, so that a stripe touches few cache lines however large the table is (after Nießner et al., "Real-time 3D
reconstruction at scale using voxel hashing", 2013). Cells that fall into one bucket share its chain: who visits a cell skips the
points of the others.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from vli_common.arrays import BoolArray, FloatArray, Int32Array

NONE = -1
"""End of a chain; an empty bucket."""
_MIN_BUCKETS = 1 << 12


class SpatialHash:
    """Chains of indices into an array of positions that the caller owns.

    Args:
        cell_m: edge of a cell; searches are cheapest at radii of about half of it.
        capacity: points that ``next`` has room for.
    """

    def __init__(self, cell_m: float, capacity: int = 1024) -> None:
        self.cell_m = cell_m
        self.heads: Int32Array = np.full(_buckets_for(capacity), NONE, np.int32)
        self.next: Int32Array = np.empty(capacity, np.int32)

    def reserve(self, capacity: int, positions: FloatArray, linked: BoolArray) -> None:
        """Make room for ``capacity`` points.

        Args:
            capacity: new number of rows.
            positions: (≥ N, 3), of the N rows in use now.
            linked: (N,), which of these are in a chain.
        """
        grown = np.empty(capacity, np.int32)
        grown[: len(linked)] = self.next[: len(linked)]
        self.next = grown
        if _buckets_for(capacity) > len(self.heads):
            self.heads = np.full(_buckets_for(capacity), NONE, np.int32)
            _link_again(self.heads, self.next, positions, linked, self.cell_m)

    @staticmethod
    def of(positions: FloatArray, cell_m: float) -> SpatialHash:
        """Return a hash of all positions (N, 3)."""
        result = SpatialHash(cell_m, max(len(positions), 1))
        link(result.heads, result.next, positions, 0, len(positions), cell_m)
        return result


def _buckets_for(capacity: int) -> int:
    """Return a power of two: about two buckets a point, since a surface fills few cells of a block."""
    return max(_MIN_BUCKETS, 1 << (2 * capacity - 1).bit_length())


@njit(cache=True, nogil=True)
def coordinates(positions, index):  # type: ignore[no-untyped-def]
    """Return x, y, z of one position, or normal, or the three values of a colour.

    To numba ``positions[index]`` is an array of its own, whose references are counted by atomic operations: that costs more than
    the visit of a point.
    """
    return positions[index, 0], positions[index, 1], positions[index, 2]


@njit(cache=True, nogil=True)
def cell_of(coordinate, cell_m):  # type: ignore[no-untyped-def]
    """Return the index of the cell along one axis."""
    return np.int64(np.floor(coordinate / cell_m))


@njit(cache=True, nogil=True)
def bucket_of(i, j, k, buckets):  # type: ignore[no-untyped-def]
    """Return the bucket of cell (i, j, k) in a table of ``buckets`` (a power of two)."""
    block = (i >> 2) * np.int64(73856093) ^ (j >> 2) * np.int64(19349663) ^ (k >> 2) * np.int64(83492791)
    block ^= block >> 15
    return ((block << 6) | ((i & 3) << 4) | ((j & 3) << 2) | (k & 3)) & (buckets - 1)


@njit(cache=True, nogil=True)
def link_one(heads, following, index, position, cell_m):  # type: ignore[no-untyped-def]
    """Put one point at the head of its chain."""
    bucket = bucket_of(cell_of(position[0], cell_m), cell_of(position[1], cell_m), cell_of(position[2], cell_m), len(heads))
    following[index] = heads[bucket]
    heads[bucket] = index


@njit(cache=True, nogil=True)
def unlink_one(heads, following, index, position, cell_m):  # type: ignore[no-untyped-def]
    """Take one point, linked at ``position``, out of its chain."""
    bucket = bucket_of(cell_of(position[0], cell_m), cell_of(position[1], cell_m), cell_of(position[2], cell_m), len(heads))
    if heads[bucket] == index:
        heads[bucket] = following[index]
        return
    at = heads[bucket]
    while at != NONE:
        if following[at] == index:
            following[at] = following[index]
            return
        at = following[at]


@njit(cache=True, nogil=True)
def link(heads, following, positions, start, stop, cell_m):  # type: ignore[no-untyped-def]
    """Link points [start, stop) of ``positions``."""
    for index in range(start, stop):
        link_one(heads, following, index, coordinates(positions, index), cell_m)


@njit(cache=True, nogil=True)
def _link_again(heads, following, positions, linked, cell_m):  # type: ignore[no-untyped-def]
    for index in range(len(linked)):
        if linked[index]:
            link_one(heads, following, index, coordinates(positions, index), cell_m)


@njit(cache=True, nogil=True)
def same_cell(position, i, j, k, cell_m):  # type: ignore[no-untyped-def]
    """Return True where ``position`` lies in cell (i, j, k)."""
    return cell_of(position[0], cell_m) == i and cell_of(position[1], cell_m) == j and cell_of(position[2], cell_m) == k


@njit(cache=True, nogil=True)
def neighbours(heads, following, positions, centre, radius, cell_m, found):  # type: ignore[no-untyped-def]
    """Write the indices of the points within ``radius`` of ``centre`` into ``found``; return how many (at most its length)."""
    count = 0
    squared = radius * radius
    for i in range(cell_of(centre[0] - radius, cell_m), cell_of(centre[0] + radius, cell_m) + 1):
        for j in range(cell_of(centre[1] - radius, cell_m), cell_of(centre[1] + radius, cell_m) + 1):
            for k in range(cell_of(centre[2] - radius, cell_m), cell_of(centre[2] + radius, cell_m) + 1):
                at = heads[bucket_of(i, j, k, len(heads))]
                while at != NONE:
                    p = coordinates(positions, at)
                    distance = (p[0] - centre[0]) ** 2 + (p[1] - centre[1]) ** 2 + (p[2] - centre[2]) ** 2
                    if distance <= squared and count < len(found) and same_cell(p, i, j, k, cell_m):
                        found[count] = at
                        count += 1
                    at = following[at]
    return count


@njit(cache=True, nogil=True)
def any_near(heads, following, positions, centre, radius, cell_m):  # type: ignore[no-untyped-def]
    """Return True where a point lies within ``radius`` of ``centre``."""
    squared = radius * radius
    for i in range(cell_of(centre[0] - radius, cell_m), cell_of(centre[0] + radius, cell_m) + 1):
        for j in range(cell_of(centre[1] - radius, cell_m), cell_of(centre[1] + radius, cell_m) + 1):
            for k in range(cell_of(centre[2] - radius, cell_m), cell_of(centre[2] + radius, cell_m) + 1):
                at = heads[bucket_of(i, j, k, len(heads))]
                while at != NONE:
                    p = coordinates(positions, at)
                    if (p[0] - centre[0]) ** 2 + (p[1] - centre[1]) ** 2 + (p[2] - centre[2]) ** 2 <= squared:
                        return True
                    at = following[at]
    return False
