"""Archives of arrays (.npz): sizes are held against the bytes of the file before anything is unpacked, arrays against the table of the file."""

from __future__ import annotations

import io
import threading
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from tokenize import TokenError

import numpy as np
from numpy.lib import format as npy

from epipole._declared.tables import Arrays, Table, check_arrays, check_names
from epipole.errors import FileFormatError, ShapeError
from epipole.io.files import most_unpacked_bytes, open_file

_DAMAGE = (
    OSError,
    ValueError,
    LookupError,
    EOFError,
    TypeError,
    ArithmeticError,
    MemoryError,
    RuntimeError,
    SyntaxError,
    zipfile.BadZipFile,
    TokenError,
    zlib.error,
)
"""What zipfile and NumPy may raise on a damaged file."""
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
_one_header_at_a_time = threading.Lock()
"""NumPy reads the header of an array with Python's parser, which up to Python 3.12 counts its depth for all threads
together and now and then takes that for an error (CPython issue 106905)."""


def read_packed_arrays(path: Path, table: Table, **sizes: int) -> Arrays:
    """The arrays of an archive that may be packed, within the budget of its size.

    Raises:
        FileFormatError: it is no archive, unpacks to more than its budget, or an array is not as expected.
    """
    with open_file(path) as stream:
        num_bytes = stream.seek(0, io.SEEK_END)
        stream.seek(0)
        found = read_archive(path, stream, table, most_unpacked_bytes(num_bytes))
    return checked_arrays(path, found, table, **sizes)


def checked_arrays(path: Path, arrays: Arrays, table: Table, **sizes: int) -> Arrays:
    """The arrays of a file, each of the type and in the layout that kernels take.

    Raises:
        FileFormatError: one is missing, unknown, or not as expected.
    """
    try:
        return check_arrays(arrays, table, **sizes)
    except ShapeError as error:
        raise FileFormatError(path, f"its arrays cannot be used: {error}") from error


def read_archive(
    path: Path,
    stream: io.BufferedIOBase,
    table: Table | None,
    most_bytes: int,
    names: Iterable[str] | None = None,
) -> Arrays:
    """The arrays as they are stored; sizes are held against the budget before anything is unpacked.

    Args:
        path: the file, for the message.
        stream: its bytes.
        table: what it holds; None: anything.
        most_bytes: to which it may unpack.
        names: of the arrays that are read; None: all that it has.

    Raises:
        FileFormatError: it is no archive, unpacks to more than `most_bytes`, or holds other arrays than the table.
    """
    try:
        with zipfile.ZipFile(stream) as archive:
            members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
            if len(members) != len(archive.infolist()):
                raise ShapeError("two arrays have one name")
            wanted = list(members if names is None else names)
            if table is not None:
                check_names(members, table, table if names is None else wanted)
            total = sum(member.file_size for member in members.values())
            if total > most_bytes:
                problem = f"unpacks to {total} bytes, more than the {most_bytes} that fit its size"
                raise FileFormatError(path, problem)
            return {name: _unpacked(archive, members[name]) for name in wanted if name in members}
    except FileFormatError:
        raise
    except ShapeError as error:
        raise FileFormatError(path, f"its arrays cannot be used: {error}") from error
    except _DAMAGE as error:
        raise FileFormatError(path, f"is no archive of arrays, or a damaged one: {error}") from error


def _unpacked(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """An array whose header tells as many bytes as there are.

    Raises:
        ValueError: it does not, or is packed in a way that may unpack to more.
    """
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{member.filename!a} is packed in an unknown way")
    with archive.open(member) as stream:
        version = npy.read_magic(stream)
        if version not in _HEADERS:
            raise ValueError(f"{member.filename!a} is of an unknown version, {version}")
        with _one_header_at_a_time:
            shape, is_fortran, dtype = _HEADERS[version](stream)
        if dtype.kind not in "biufU" or any(side < 0 for side in shape):
            raise ValueError(f"{member.filename!a} holds {dtype}, neither numbers nor text")
        count = 1
        for side in shape:
            count *= int(side)
        is_empty_text = dtype.itemsize == 0 and count == 1
        if count * dtype.itemsize != member.file_size - stream.tell() or (
            dtype.itemsize == 0 and not is_empty_text
        ):
            raise ValueError(f"{member.filename!a} is not as long as its header says")
        data = bytearray(stream.read())
        if len(data) != count * dtype.itemsize:
            raise ValueError(f"{member.filename!a} is cut short")
    flat = np.frombuffer(data, dtype, count) if data else np.zeros(count, dtype)
    return flat.reshape(shape, order="F" if is_fortran else "C")
