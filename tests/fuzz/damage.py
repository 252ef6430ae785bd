"""Damage to valid files, by a seeded `random.Random`: bytes, and the structure that holds them."""

import bz2
import io
import json
import re
import sqlite3
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from epipole.runs.units import store
from hostile_bytes import NUMBERS, WORDS

_NUMBER = re.compile(rb"[-+]?\d[\d.]*(?:[eE][-+]?\d+)?")
_LINE = re.compile(rb"[^\n]*\n?")
_SHORT = [struct.pack(order + "H", v) for order in "<>" for v in (0, 1, 8, 16, 255, 0x7FFF, 0x8000, 0xFFFF)]
_TEXTS = (
    *(
        b"\0",
        b"\xff\xfe",
        b"\xed\xa0\x80",
        b"\r",
        b"\n",
        b"\t",
        b" ",
        b"\xc2\x85",
        b"#",
        b",",
        b";",
        b"=",
        b":",
    ),
    *(
        b"..",
        b"/etc/passwd",
        b"a" * 5000,
        b"\x1b[31m",
        b"-",
        b"'",
        b'"',
        b"[" * 2000,
        b"{",
        b"}",
        b"]",
        b"%s",
    ),
)
_YAML = (
    *(
        b"&a ",
        b"*a",
        b"<<: *a\n",
        b"!!int ",
        b"!!float ",
        b"!!binary ",
        b"!!set ",
        b"!!omap ",
        b"!!timestamp ",
    ),
    *(
        b"!!python/object/apply:os.getcwd []",
        b"? ",
        b"| ",
        b"> ",
        b"---\n",
        b"...\n",
        b"%TAG ! x\n",
        b"@",
        b"`",
    ),
    *(
        b"&a [*a, *a]",
        b"{<<: [*a, *a]}",
        b"~",
        b"1:2:3",
        b".inf",
        b"- " * 200,
        b"!!opencv-matrix ",
        b"!!str ",
    ),
)


def damaged(rng: Random, data: bytes, kind: str) -> bytes:
    """One to three kinds of damage, most of them such as leave the frame of the format whole."""
    own = _OWN.get(kind)
    if kind == "exif":
        return _exif(rng, data)
    if own is not None and rng.random() < 0.7:
        with suppress(*_UNREADABLE):
            return own(rng, data)
    common = _COMMON + (_OF_TEXT if kind in ("text", "json", "yaml", "bz2", "answers") else _OF_BYTES)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        data = rng.choice(common)(rng, data)
    return data


_UNREADABLE = (
    ValueError,
    KeyError,
    IndexError,
    struct.error,
    zlib.error,
    OSError,
    zipfile.BadZipFile,
    RecursionError,
)


def _cut(rng: Random, data: bytes) -> bytes:
    return data[: rng.randint(0, len(data))]


def _flip(rng: Random, data: bytes) -> bytes:
    out = bytearray(data)
    for _ in range(rng.randint(1, 4) if out else 0):
        out[rng.randrange(len(out))] ^= rng.randint(1, 255)
    return bytes(out)


def _grow(rng: Random, data: bytes) -> bytes:
    at = rng.randint(0, len(data))
    return data[:at] + rng.choice((rng.randbytes(rng.randint(1, 20)), rng.choice(WORDS))) + data[at:]


def _piece(rng: Random, data: bytes) -> tuple[int, int]:
    first = rng.randint(0, len(data))
    return first, min(len(data), first + rng.randint(0, 200))


def _repeat(rng: Random, data: bytes) -> bytes:
    first, last = _piece(rng, data)
    return data[:last] + data[first:last] * rng.choice((1, 2, 3, 50)) + data[last:]


def _leave_out(rng: Random, data: bytes) -> bytes:
    first, last = _piece(rng, data)
    return data[:first] + data[last:]


def _other_word(rng: Random, data: bytes) -> bytes:
    """A word of 16, 32 or 64 bits becomes another, mostly where such words are aligned."""
    word = rng.choice(WORDS) if rng.random() < 0.7 else rng.choice(_SHORT)
    at = rng.randint(0, max(0, len(data) - len(word)))
    at = at if rng.random() < 0.5 else at - at % len(word)
    return data[:at] + word + data[at + len(word) :]


def _other_number(rng: Random, data: bytes) -> bytes:
    found = list(_NUMBER.finditer(data))
    if not found:
        return data
    position = rng.choice(found)
    return data[: position.start()] + rng.choice(NUMBERS).encode() + data[position.end() :]


def _other_line(rng: Random, data: bytes) -> bytes:
    """A line once more, left out, or in the place of another."""
    lines = _LINE.findall(data)
    taken, put, keep = rng.randrange(len(lines)), rng.randrange(len(lines)), rng.randint(0, 2)
    lines[put : put + 1] = [lines[put], lines[taken]][: keep + 1] if keep else []
    return b"".join(lines)


def _other_text(rng: Random, data: bytes) -> bytes:
    at = rng.randint(0, len(data))
    return data[:at] + rng.choice(_TEXTS) + data[at + rng.choice((0, 0, 1, 5)) :]


_COMMON = [_cut, _flip, _grow, _repeat, _leave_out]
_OF_TEXT = [_other_number] * 4 + [_other_line, _other_text, _other_text]
_OF_BYTES = [_other_word] * 5


def _yaml(rng: Random, data: bytes) -> bytes:
    """Anchors, tags and marks of YAML at the beginning of words."""
    for _ in range(rng.randint(1, 3)):
        positions = [m.start() for m in re.finditer(rb"(?<=[\s\[,:])\S", data)] or [0]
        at = rng.choice(positions)
        data = data[:at] + rng.choice(_YAML) + data[at:]
    return data


_RAW = re.compile(r'"@raw(\d+)@"')
_RAW_JSON = (
    *NUMBERS[:28],
    "NaN",
    "1e999",
    '"\\ud800"',
    "[" * 3000,
    '"a\\u0000b"',
    "-",
    '"' + "x" * 5000 + '"',
)


def _json_value(rng: Random, known: list[Any]) -> Any:
    choices = [None, True, "", [], {}, [[]], "a", 0, -1, 0.5, [1] * 40, rng.choice(known)]
    return f"@raw{rng.randrange(len(_RAW_JSON))}@" if rng.random() < 0.5 else rng.choice(choices)


def _nodes(value: Any) -> list[tuple[Any, Any]]:
    """(container, key or index) of every value in a tree."""
    own = list(value.items() if isinstance(value, dict) else enumerate(value))
    below = [node for _, v in own if isinstance(v, dict | list) for node in _nodes(v)]
    return [(value, key) for key, _ in own] + below


def _json(rng: Random, data: bytes) -> bytes:
    """Values of the tree swapped, removed, doubled or replaced."""
    tree = json.loads(data)
    for _ in range(rng.randint(1, 3)):
        positions = _nodes(tree)
        if not positions:
            break
        inside, key = rng.choice(positions)
        other, other_key = rng.choice(positions)
        what = rng.randrange(5)
        if what == 0:
            del inside[key]
        elif what == 1 and isinstance(inside, list):
            inside.insert(key, inside[key])
        elif what == 2:
            inside[key] = json.loads(json.dumps(other[other_key]))
        else:
            inside[key] = _json_value(
                rng, [c[k] for c, k in positions if not isinstance(c[k], dict | list)] or [0]
            )
    text = json.dumps(tree, indent=1)
    return _RAW.sub(lambda found: _RAW_JSON[int(found[1])], text).encode()


def _as_text(rng: Random, data: bytes) -> bytes:
    return rng.choice(_OF_TEXT + _COMMON)(rng, data)


def _bz2(rng: Random, data: bytes) -> bytes:
    return bz2.compress(_as_text(rng, bz2.decompress(data)))


def _ply(rng: Random, data: bytes) -> bytes:
    """The header is text, whatever follows."""
    end = data.index(b"end_header\n") + len(b"end_header\n")
    return _as_text(rng, data[:end]) + data[end:]


def _pfm(rng: Random, data: bytes) -> bytes:
    """Three lines of text, and numbers."""
    head = b"".join(_LINE.findall(data)[:3])
    return _as_text(rng, head) + data[len(head) :]


def png_chunk(kind: bytes, data: bytes) -> bytes:
    """A chunk with the sum that belongs to it."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


_PNG_CHUNKS: tuple[tuple[bytes, bytes], ...] = (
    (b"zTXt", b"key\0\0" + zlib.compress(bytes(3 << 20), 9)),
    (b"iTXt", b"key\0\1\0\0\0" + zlib.compress(bytes(3 << 20), 9)),
    (b"iCCP", b"key\0\0" + zlib.compress(bytes(3 << 20), 9)),
    (b"acTL", struct.pack(">II", 0xFFFFFFFF, 0)),
    (b"fcTL", struct.pack(">IIIIIHHBB", 0, 0x7FFFFFFF, 0x7FFFFFFF, 0, 0, 1, 1, 0, 0)),
    (b"fdAT", struct.pack(">I", 1) + zlib.compress(bytes(100))),
    *((b"eXIf", b"MM\0*\xff\xff\xff\xff"), (b"tRNS", b"\0\1"), (b"PLTE", b"\0" * 7), (b"tEXt", b"\0")),
    *((b"pHYs", b"\0"), (b"gAMA", b""), (b"IEND", b""), (b"sRGB", rb"\9")),
)


def _png(rng: Random, data: bytes) -> bytes:
    """Chunks changed, doubled, moved and put in, their sums corrected; or other pixels, packed again."""
    chunks, at = [], 8
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    k = rng.randrange(len(chunks))
    what = rng.randrange(5)
    if what == 0:
        chunks.insert(k, rng.choice(_PNG_CHUNKS))
    elif what == 1:
        chunks.insert(rng.randrange(len(chunks)), chunks[k])
    elif what == 2:
        chunks[0] = (b"IHDR", _other_word(rng, chunks[0][1]))
    elif what == 3:
        chunks[k] = (chunks[k][0], rng.choice([_flip, _cut, _grow, _other_word])(rng, chunks[k][1]))
    else:
        k = [kind for kind, _ in chunks].index(b"IDAT")
        pixels = rng.choice([_flip, _cut, _grow, _repeat])(rng, zlib.decompress(chunks[k][1]))
        chunks[k] = (b"IDAT", zlib.compress(pixels))
    return data[:8] + b"".join(png_chunk(*chunk) for chunk in chunks)


def _jpeg(rng: Random, data: bytes) -> bytes:
    """Segments changed, doubled, moved or left out; their lengths stay right."""
    segments, at = [], 2
    while data[at + 1] != 0xDA:
        (length,) = struct.unpack_from(">H", data, at + 2)
        segments.append((data[at + 1 : at + 2], data[at + 4 : at + 2 + length]))
        at += 2 + length
    k, what = rng.randrange(len(segments)), rng.randrange(4)
    if what == 0:
        segments.insert(rng.randrange(len(segments)), segments[k])
    elif what == 1:
        del segments[k]
    else:
        content = rng.choice([_flip, _cut, _grow, _other_word, _other_word])(rng, segments[k][1])
        segments[k] = (segments[k][0], content[:65000])
    head = b"".join(b"\xff" + m + struct.pack(">H", len(c) + 2) + c for m, c in segments)
    return data[:2] + head + data[at:] * rng.choice((1, 1, 1, 2, 30))


def _exif(rng: Random, data: bytes) -> bytes:
    """The EXIF block of a JPEG alone, in a segment that holds it."""
    start = data.index(b"Exif\0\0")
    end = start - 2 + int.from_bytes(data[start - 2 : start], "big")
    block = data[start + 6 : end]
    for _ in range(rng.randint(1, 3)):
        block = rng.choice(_COMMON + _OF_BYTES)(rng, block)[:60000]
    return data[: start - 2] + (len(block) + 8).to_bytes(2, "big") + b"Exif\0\0" + block + data[end:]


def _zip(rng: Random, data: bytes) -> bytes:
    """One member changed, its sum corrected; or left out, or under another name."""
    with zipfile.ZipFile(io.BytesIO(data)) as source:
        members = [(name, source.read(name)) for name in source.namelist()]
    k, what = rng.randrange(len(members)), rng.randrange(6)
    if what == 0:
        del members[k]
    elif what == 1:
        members[k] = (rng.choice(["../a.npy", "a" * 300, members[k][0]]), members[k][1])
    else:
        change = rng.choice([_flip, _cut, _grow, _other_word, _as_text, _as_text])
        members[k] = (members[k][0], change(rng, members[k][1]))
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as target:
        for name, content in members:
            target.writestr(zipfile.ZipInfo(name), content)
    return out.getvalue()


_SPECIAL = (
    0,
    1,
    -1,
    2,
    7,
    255,
    -(2**31),
    2**31,
    2**53,
    2**62,
    -(2**62),
    0.5,
    1e308,
    -1e160,
    1e-320,
    np.nan,
    np.inf,
)
_TYPES = ("f8", "f4", "f2", "i8", "i4", "u1", "?", "U3", ">f8", "c16")


def _other_array(rng: Random, array: np.ndarray) -> np.ndarray:
    """Other lengths, axes or numbers, mostly within the type."""
    what = rng.randrange(12)
    if array.dtype.kind == "U":
        choices = [array[None], array.astype("S"), np.array("a" * 3000), np.array(""), np.repeat(array, 2)]
        return rng.choice(choices)
    if what == 0 and array.ndim:
        return array[: rng.randint(0, len(array))]
    if what == 1 and array.ndim:
        return np.concatenate([array, array[: rng.randint(0, len(array))]])
    if what == 2:
        return rng.choice(
            [array[None], array.ravel(), array.T, array[..., None], array[:0] if array.ndim else array]
        )
    if what == 3:
        with np.errstate(all="ignore"):
            return array.astype(rng.choice(_TYPES))
    out = array.copy()
    for _ in range(rng.randint(1, 4) if out.size else 0):
        with suppress(OverflowError, ValueError), np.errstate(all="ignore"):
            value = rng.choice([*_SPECIAL, *out.flat[[rng.randrange(out.size)]].tolist()])
            out.flat[rng.randrange(out.size) if rng.random() < 0.7 else slice(None)] = value
    return out


def _sealed(rng: Random, data: bytes) -> bytes:
    """Arrays of one of our archives changed, left out or swapped, and its digest made anew: as somebody would who knows how."""
    with np.load(io.BytesIO(data)) as archive:
        arrays = dict(archive)
    key = str(arrays.pop("key"))
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        name = rng.choice(sorted(arrays) or [""])
        what = rng.random()
        if not name or what < 0.03:
            arrays["other"] = np.zeros(3)
        elif what < 0.06:
            del arrays[name]
        elif what < 0.1:
            arrays[name] = arrays[rng.choice(sorted(arrays))]
        elif name == "text" and arrays[name].dtype == np.uint8:  # JSON
            with suppress(ValueError, RecursionError):
                arrays[name] = np.frombuffer(_json(rng, arrays[name].tobytes()), np.uint8)
        else:
            arrays[name] = _other_array(rng, arrays[name])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.npz"
        store(path, key, arrays)
        return path.read_bytes()


def _answer_lines(rng: Random, data: bytes) -> bytes:
    """Lines of JSON that each begin with their checksum, computed again."""
    lines = [line.partition(b" ")[2] for line in data.splitlines()]
    k, what = rng.randrange(len(lines)), rng.randrange(6)
    if what == 0:
        lines.insert(k, rng.choice(lines))
    elif what == 1:
        del lines[k]
    else:
        lines[k] = b" ".join(_json(rng, lines[k]).split())
    return b"".join(b"%08x %b\n" % (zlib.crc32(line), line) for line in lines)


_SQL_VALUES = (
    *(
        "NULL",
        "-1",
        "0",
        "1",
        "1.5",
        "9223372036854775807",
        "-9223372036854775808",
        "2147483647",
        "99",
        "1e999",
    ),
    *(
        "'text'",
        "''",
        "X''",
        "X'00'",
        "zeroblob(64)",
        "zeroblob(3000000)",
        "randomblob(48)",
        "'a' || char(0)",
    ),
    *("CAST(X'ff80' AS TEXT)", "CAST(X'6100' AS TEXT)", "printf('%05000d', 1)", "'0x10'", "-0.0"),
)
_SQL = (
    *(
        "DROP TABLE {t}",
        "ALTER TABLE {t} RENAME TO other",
        "DELETE FROM {t}",
        "DELETE FROM {t} WHERE rowid = 1",
    ),
    "ALTER TABLE {t} RENAME COLUMN {c} TO other",
    "CREATE TABLE other AS SELECT * FROM {t}; DROP TABLE {t}; ALTER TABLE other RENAME TO {t};"
    " INSERT INTO {t} SELECT * FROM {t}; UPDATE {t} SET {c} = {v} WHERE rowid = 2",
    "CREATE TABLE other AS SELECT * FROM {t}; DROP TABLE {t}; CREATE VIEW {t} AS SELECT * FROM other",
    "ALTER TABLE {t} RENAME TO other; CREATE VIEW {t} AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1"
    " FROM n) SELECT other.* FROM other, n",
    "CREATE TABLE other AS SELECT * FROM {t}; DROP TABLE {t}; CREATE TABLE {t} (x, {c} AS (hex(zeroblob(9e8))))",
    "PRAGMA user_version = -1",
    "PRAGMA encoding = 'UTF-16'",
)


def _sqlite(rng: Random, data: bytes) -> bytes:
    """Cells of other types and sizes, tables and columns that are not what they were."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.db"
        path.write_bytes(data)
        with closing(sqlite3.connect(path, isolation_level=None)) as database:
            database.execute("PRAGMA synchronous = OFF")
            database.execute("PRAGMA ignore_check_constraints = ON")
            tables = [
                row[0] for row in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
            ]
            for _ in range(rng.randint(1, 3)):
                table = rng.choice([t for t in tables if not t.startswith("sqlite")])
                columns = [row[1] for row in database.execute(f"PRAGMA table_info({table})")]
                if not columns:
                    continue
                column, value = rng.choice(columns), rng.choice(_SQL_VALUES)
                change = f"UPDATE OR IGNORE {table} SET {column} = {value} WHERE random() % 2"
                what = rng.choice(_SQL).format(t=table, c=column, v=value) if rng.random() < 0.25 else change
                with suppress(sqlite3.Error):
                    database.executescript(what)
        return path.read_bytes()


_OWN: dict[str, Callable[[Random, bytes], bytes]] = {
    **{"json": _json, "yaml": _yaml, "bz2": _bz2, "ply": _ply, "png": _png, "jpeg": _jpeg, "zip": _zip},
    **{"sqlite": _sqlite, "pfm": _pfm},
    **{"sealed": _sealed, "answers": _answer_lines},
}
