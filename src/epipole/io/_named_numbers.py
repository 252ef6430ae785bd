"""Numbers and matrices from parsed YAML, XML and JSON calibration files."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from epipole.errors import FileFormatError

_MOST_PIXELS = 1 << 20  # along a side
_ROUNDED = 1e-4
_MOST_YAML, _MOST_VALUES, _LONGEST_VALUE, _DEEPEST = 1 << 20, 100_000, 1 << 16, 32
_CHANNELS = re.compile(r"(\d{0,3})[ucwsifdh]")


def numbers_of(path: Path, content: Mapping[str, Any], key: str, *shape: int) -> np.ndarray:
    """A matrix (a vector if no shape is given), written as lists, as a `data` list, or as numbers in one string.

    Raises:
        FileFormatError: the key is missing or has another type or shape.
    """
    if key not in content:
        raise FileFormatError(path, f"the key {key} is missing")
    value = content[key]
    if isinstance(value, Mapping):
        value = _data_of(path, key, value)
    if isinstance(value, str):
        value = re.sub(r"[\[\];,]", " ", value).split()
    try:
        array = np.asarray(value, np.float64)
        array = array.reshape(shape) if shape else array.ravel()
    except (TypeError, ValueError, OverflowError) as error:
        what = f"{' x '.join(map(str, shape))} numbers" if shape else "a list of numbers"
        raise FileFormatError(path, f"{key} is not {what}") from error
    if not np.isfinite(array).all():
        raise FileFormatError(path, f"{key} contains values that are not finite")
    return array


def _data_of(path: Path, key: str, matrix: Mapping[str, Any]) -> Any:
    """The values of a matrix, checked against its rows and columns if they are given."""
    data = matrix.get("data", matrix)
    data = data.split() if isinstance(data, str) else data
    if isinstance(data, list) and "rows" in matrix and "cols" in matrix:
        channels = _CHANNELS.fullmatch(str(matrix.get("dt", "d")))
        try:
            rows, cols = int(matrix["rows"]), int(matrix["cols"])
        except (TypeError, ValueError, OverflowError):
            rows = cols = -1
        if channels is None or min(rows, cols) < 0 or rows * cols * int(channels[1] or 1) != len(data):
            raise FileFormatError(path, f"{key} does not have the size given by its rows, cols and dt")
    return data


def is_rotation(matrix: np.ndarray) -> bool:
    """Whether a matrix is a rotation up to rounding (files store few digits)."""
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() <= _ROUNDED and np.linalg.det(matrix) > 0)


class _BoundedLoader(yaml.SafeLoader):  # type: ignore[misc]  # PyYAML has no types
    """Limits the number of values after alias expansion: a few aliased lines can expand to billions."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._count = self._depth = 0
        self._count_of: dict[str, int] = {}

    def compose_node(self, parent: Any, index: Any) -> Any:
        """The next node; checks its depth, its size and its expanded number of values."""
        event, before = self.peek_event(), self._count
        anchor = event.anchor
        is_alias = isinstance(event, yaml.AliasEvent)
        if is_alias and anchor in self.anchors and anchor not in self._count_of:
            raise ValueError("an alias refers to the anchor that contains it")
        self._count += self._count_of.get(anchor, 0) if is_alias else 1
        self._depth += 1
        if self._count > _MOST_VALUES:
            raise ValueError(f"with aliases expanded, it has more than {_MOST_VALUES} values")
        if self._depth > _DEEPEST:
            raise ValueError(f"it is nested more than {_DEEPEST} levels deep")
        if isinstance(event, yaml.ScalarEvent) and len(event.value) > _LONGEST_VALUE:
            raise ValueError(f"a value has {len(event.value)} characters")
        node = super().compose_node(parent, index)
        self._depth -= 1
        if anchor is not None and not is_alias:
            self._count_of[anchor] = self._count - before
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        """Names and values; rejects duplicate names, which PyYAML would silently drop."""
        names = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        twice = next((name for name, count in Counter(names).items() if count > 1 and name != "<<"), None)
        if twice is not None:
            raise ValueError(f"duplicate key {twice[:80]}")
        return super().construct_mapping(node, deep)


def yaml_values(text: str) -> Any:
    """Parse YAML text within bounds that every real calibration fits.

    Raises:
        ValueError: the text is not YAML, or exceeds the limits on size, depth or number of values.
    """
    if len(text) > _MOST_YAML:
        raise ValueError(f"it has more than {_MOST_YAML} characters")
    try:
        loader = _BoundedLoader(text)
        try:
            return loader.get_single_data()
        finally:
            loader.dispose()
    except (yaml.YAMLError, LookupError, AttributeError, TypeError, ArithmeticError, RecursionError) as error:
        # PyYAML's constructors leak internal errors: `!!int ''` raises an IndexError.
        raise ValueError(str(error) or type(error).__name__) from error


def xml_values(data: bytes) -> dict[str, Any]:
    """Numbers and strings of an OpenCV XML file by name; a matrix is a dict of its parts as strings.

    OpenCV's own reader is not used because a damaged file crashes the process.

    Raises:
        ValueError: the text is not OpenCV XML, or defines entities, which can expand to billions of characters.
    """
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise ValueError("it defines XML entities")
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, LookupError) as error:
        raise ValueError(str(error)) from error
    if root.tag != "opencv_storage":
        raise ValueError(f"it starts with <{root.tag[:20]}>, not <opencv_storage>")
    tags = [node.tag for node in root]
    twice = next((tag for tag, count in Counter(tags).items() if count > 1), None)
    if twice is not None:
        raise ValueError(f"duplicate key {twice[:80]}")
    return {node.tag: _xml_value(node) for node in root}


def _xml_value(node: ElementTree.Element) -> float | str | dict[str, str]:
    if node.find("data") is not None:
        return {part.tag: (part.text or "").strip() for part in node}
    text = node.text or ""
    try:
        return float(text)
    except ValueError:
        return text.strip()


def size_of(path: Path, width: float, height: float) -> tuple[int, int]:
    """Width and height of images as integers.

    Raises:
        FileFormatError: they are not valid image sizes.
    """
    if not (1 <= width <= _MOST_PIXELS and 1 <= height <= _MOST_PIXELS):
        raise FileFormatError(path, f"an image size of {width:g} x {height:g} pixels is not valid")
    return int(width), int(height)
