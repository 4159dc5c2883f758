"""``sensor_msgs/PointCloud2`` with named fields ⇄ structured numpy arrays, without copying on the way in.

A cloud without rows has no place for values, so its session stands in the padding of its one (empty) row, which PointCloud2
provides for: ``row_step`` is 4 and ``data`` holds one little-endian uint32.
"""

from __future__ import annotations

import array
import functools
import math
from collections.abc import Collection

import numpy as np
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from vli_common.arrays import AnyArray, ByteArray, Float32Array
from vli_common.errors import MessageError
from vli_common.messages.limits import checked

_DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
_FORMATS = {code: f"<{name}" for name, code in _DATATYPES.items()}
_MAX_FIELDS = 64
_MAX_POINT_BYTES = 2**20
_SESSION_BYTES = 4


def byte_array(values: AnyArray) -> array.array[int]:
    """Return the bytes of a contiguous array the way that a message field takes them without a loop."""
    data = array.array("B")
    if values.size:
        data.frombytes(np.ascontiguousarray(values).reshape(-1).view(np.uint8).data)
    return data


def cloud_from_rows(rows: AnyArray, header: Header, session: int) -> PointCloud2:
    """Return the cloud of a structured array (N,); its ``session`` column is set here."""
    rows["session"] = session
    step = rows.dtype.itemsize
    empty = len(rows) == 0
    return PointCloud2(
        header=header,
        height=1,
        width=len(rows),
        fields=list(_point_fields(rows.dtype)),
        is_bigendian=False,
        point_step=step,
        row_step=_SESSION_BYTES if empty else step * len(rows),
        data=byte_array(np.array([session], "<u4") if empty else rows),
        is_dense=True,
    )


def rows_from_cloud(message: PointCloud2, layout: np.dtype[np.void], infinite: Collection[str] = ()) -> AnyArray:
    """Return a read-only structured view (N,) of a cloud whose fields include those of ``layout``, at any offset.

    Args:
        message: from a topic, not to be trusted.
        layout: wanted names and types.
        infinite: fields that may be infinite; NaN is refused everywhere.

    Raises:
        MessageError: fields missing or of another type, sizes that do not fit the data, values that are not finite, or too large
            for anything measured.
    """
    dtype = _message_dtype(message, layout)
    data = np.frombuffer(message.data, np.uint8)
    width, height, row_step = message.width, message.height, message.row_step
    if row_step < width * message.point_step or len(data) != row_step * height:
        raise MessageError(
            f"cloud of '{height}' rows of '{row_step}' bytes, '{width}' points of '{message.point_step}' bytes each, "
            f"does not fit its '{len(data)}' bytes of data"
        )
    if width * height == 0:
        return np.empty(0, layout)
    rows: AnyArray = np.ndarray((height, width), dtype, data, strides=(row_step, message.point_step)).reshape(-1)
    rows.flags.writeable = False
    _check_values(rows, layout, infinite)
    return rows


def cloud_session(message: PointCloud2, rows: AnyArray) -> int:
    """Return the session of a cloud read by :func:`rows_from_cloud`.

    Raises:
        MessageError: rows of several sessions, or none at all.
    """
    if len(rows):
        session = rows["session"]
        if (session != session[0]).any():
            raise MessageError(f"cloud has rows of sessions '{session.min()}' to '{session.max()}', expected one session")
        return int(session[0])
    if len(message.data) < _SESSION_BYTES:
        raise MessageError("cloud has no rows and does not say of which session it is")
    return int(np.frombuffer(message.data, "<u4", 1)[0])


def field_count(message: PointCloud2, name: str) -> int:
    """Return the ``count`` of a field.

    Raises:
        MessageError: there is no such field.
    """
    for item in message.fields:
        if item.name == name:
            return int(item.count)
    raise MessageError(f"cloud has no field '{name}', it has '{', '.join(item.name for item in message.fields[:_MAX_FIELDS])}'")


def pack_rgb(colours: ByteArray) -> Float32Array:
    """Return colours (N, 3) uint8 RGB as (N,) float32 whose bits are 0x00RRGGBB."""
    wide = colours.astype(np.uint32)
    packed = (wide[:, 0] << np.uint32(16)) | (wide[:, 1] << np.uint32(8)) | wide[:, 2]
    return packed.astype("<u4").view("<f4")


def unpack_rgb(packed: Float32Array) -> ByteArray:
    """Return (N, 3) uint8 RGB of (N,) float32 whose bits are 0x00RRGGBB."""
    bits = np.ascontiguousarray(packed, "<f4").view("<u4")
    return np.stack([(bits >> np.uint32(shift)) & np.uint32(255) for shift in (16, 8, 0)], axis=1).astype(np.uint8)


@functools.lru_cache(maxsize=64)
def _point_fields(dtype: np.dtype[np.void]) -> tuple[PointField, ...]:
    fields = []
    for name in dtype.names or ():
        item, offset = dtype.fields[name][:2]  # type: ignore[index]
        base, shape = item.subdtype or (item, (1,))
        fields.append(PointField(name=name, offset=offset, datatype=_DATATYPES[base.str[1:]], count=math.prod(shape)))
    return tuple(fields)


def _message_dtype(message: PointCloud2, layout: np.dtype[np.void]) -> np.dtype[np.void]:
    """Return ``layout`` with the offsets and the point size of the message."""
    if message.is_bigendian:
        raise MessageError("cloud is big-endian, expected little-endian")
    if len(message.fields) > _MAX_FIELDS:
        raise MessageError(f"cloud has '{len(message.fields)}' fields, expected at most {_MAX_FIELDS}")
    if message.point_step > _MAX_POINT_BYTES:
        raise MessageError(f"cloud has points of '{message.point_step}' bytes, expected at most {_MAX_POINT_BYTES}")
    found = {item.name: item for item in message.fields}
    if len(found) != len(message.fields):
        raise MessageError(f"cloud has a field twice: '{', '.join(item.name for item in message.fields)}'")
    offsets = []
    for wanted in _point_fields(layout):
        item = found.get(wanted.name)
        if item is None:
            raise MessageError(f"cloud has no field '{wanted.name}', it has '{', '.join(found)}'")
        if (item.datatype, item.count) != (wanted.datatype, wanted.count):
            raise MessageError(
                f"field '{item.name}' has type '{_FORMATS.get(item.datatype, item.datatype)}' × '{item.count}', "
                f"expected '{_FORMATS[wanted.datatype]}' × '{wanted.count}'"
            )
        if item.offset + layout[item.name].itemsize > message.point_step:
            raise MessageError(f"field '{item.name}' at '{item.offset}' ends outside points of '{message.point_step}' bytes")
        offsets.append(item.offset)
    names = list(layout.names or ())
    formats = [layout[name] for name in names]
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": message.point_step})


def _check_values(rows: AnyArray, layout: np.dtype[np.void], infinite: Collection[str]) -> None:
    for name in layout.names or ():
        # The bits of a packed colour are no number: black with full red is a NaN to nobody but numpy.
        if layout[name].kind != "f" or name == "rgb":
            continue
        column = rows[name]
        checked(column[~np.isinf(column)] if name in infinite else column, f"field '{name}'")
