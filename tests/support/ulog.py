"""A minimal ULog reader: the data messages of one topic, by field name. PX4 user guide, "ULog File Format"."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_TYPES = {
    "int8_t": "<i1",
    "uint8_t": "<u1",
    "int16_t": "<i2",
    "uint16_t": "<u2",
    "int32_t": "<i4",
    "uint32_t": "<u4",
    "int64_t": "<i8",
    "uint64_t": "<u8",
    "float": "<f4",
    "double": "<f8",
    "bool": "?",
    "char": "S1",
}
_HEADER = 16


def read_topic(path: Path, topic: str) -> NDArray[np.void]:
    """All messages of the first instance of a flat topic as a structured array.

    Raises:
        ValueError: no ULog, or the topic is not in it.
    """
    data = path.read_bytes()
    if not data.startswith(b"ULog\x01\x12\x35"):
        raise ValueError(f"{path.name} is no ULog")
    formats: dict[str, str] = {}
    wanted: int | None = None
    rows: list[bytes] = []
    at = _HEADER
    while at + 3 <= len(data):
        size, kind = struct.unpack_from("<Hc", data, at)
        body = data[at + 3 : at + 3 + size]
        at += 3 + size
        if kind == b"F":
            name, _, fields = body.decode().partition(":")
            formats[name] = fields
        elif kind == b"A" and body[0] == 0 and body[3:].decode() == topic:
            (wanted,) = struct.unpack_from("<H", body, 1)
        elif kind == b"D" and wanted is not None and struct.unpack_from("<H", body)[0] == wanted:
            rows.append(body[2:])
    if not rows:
        raise ValueError(f"{path.name} holds no {topic}")
    dtype = _dtype(formats[topic])
    # Trailing padding may be left out of the log.
    return np.frombuffer(b"".join(row.ljust(dtype.itemsize, b"\0") for row in rows), dtype)


def _dtype(fields: str) -> np.dtype[np.void]:
    made: list[tuple[str, str] | tuple[str, str, int]] = []
    for field in filter(None, fields.split(";")):
        kind, name = field.split(" ")
        kind, _, count = kind.rstrip("]").partition("[")
        made.append((name, _TYPES[kind], int(count)) if count else (name, _TYPES[kind]))
    return np.dtype(made)
