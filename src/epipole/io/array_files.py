"""Archives of arrays (.npz), with sizes and array types checked before anything is unpacked."""

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

from epipole._checks.tables import Arrays, Table, check_arrays, check_names
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
"""Exceptions that zipfile and NumPy raise on damaged files."""
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
_one_header_at_a_time = threading.Lock()
"""NumPy parses array headers with Python's parser, whose depth counter is shared by all threads up to Python 3.12 and
sporadically raises a false error (CPython issue 106905)."""


def read_packed_arrays(path: Path, table: Table, **sizes: int) -> Arrays:
    """Read an archive that may be compressed, with a limit on its unpacked size.

    Raises:
        FileFormatError: it is not an archive, unpacks to more than the limit, or an array is not as expected.
    """
    with open_file(path) as stream:
        num_bytes = stream.seek(0, io.SEEK_END)
        stream.seek(0)
        found = read_archive(path, stream, table, most_unpacked_bytes(num_bytes))
    return checked_arrays(path, found, table, **sizes)


def checked_arrays(path: Path, arrays: Arrays, table: Table, **sizes: int) -> Arrays:
    """Check arrays against a table and return them with the dtype and layout that kernels need.

    Raises:
        FileFormatError: an array is missing, unknown, or not as expected.
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
    """Read arrays as stored; their sizes are checked against the limit before anything is unpacked.

    Args:
        path: the file, for error messages.
        stream: its bytes.
        table: the expected arrays; None: any.
        most_bytes: the largest unpacked size.
        names: the arrays to read; None: all.

    Raises:
        FileFormatError: not an archive, unpacks to more than `most_bytes`, or has other arrays than `table`.
    """
    try:
        with zipfile.ZipFile(stream) as archive:
            members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
            if len(members) != len(archive.infolist()):
                raise ShapeError("two arrays have the same name")
            wanted = list(members if names is None else names)
            if table is not None:
                check_names(members, table, table if names is None else wanted)
            total = sum(member.file_size for member in members.values())
            if total > most_bytes:
                problem = f"unpacks to {total} bytes, more than the {most_bytes} allowed for its size"
                raise FileFormatError(path, problem)
            return {name: _unpacked(archive, members[name]) for name in wanted if name in members}
    except FileFormatError:
        raise
    except ShapeError as error:
        raise FileFormatError(path, f"its arrays cannot be used: {error}") from error
    except _DAMAGE as error:
        raise FileFormatError(path, f"not an archive of arrays, or damaged: {error}") from error


def _unpacked(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """Unpack an array whose header matches its length.

    Raises:
        ValueError: it does not match, or the compression method is unknown.
    """
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{member.filename!a} uses an unknown compression method")
    with archive.open(member) as stream:
        version = npy.read_magic(stream)
        if version not in _HEADERS:
            raise ValueError(f"{member.filename!a} has the unknown format version {version}")
        with _one_header_at_a_time:
            shape, is_fortran, dtype = _HEADERS[version](stream)
        if dtype.kind not in "biufU" or any(side < 0 for side in shape):
            raise ValueError(f"{member.filename!a} has dtype {dtype}, neither numbers nor text")
        count = 1
        for side in shape:
            count *= int(side)
        is_empty_text = dtype.itemsize == 0 and count == 1
        if count * dtype.itemsize != member.file_size - stream.tell() or (
            dtype.itemsize == 0 and not is_empty_text
        ):
            raise ValueError(f"{member.filename!a} does not have the length given in its header")
        data = bytearray(stream.read())
        if len(data) != count * dtype.itemsize:
            raise ValueError(f"{member.filename!a} is truncated")
    flat = np.frombuffer(data, dtype, count) if data else np.zeros(count, dtype)
    return flat.reshape(shape, order="F" if is_fortran else "C")
