"""Numbers under a key of a file that was read into names and values."""

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
    """A matrix (a vector where no shape is given), however it is written: lists, a `data` list, or words in a line.

    Raises:
        FileFormatError: the key is missing, or holds something else.
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
        raise FileFormatError(path, f"{key} has values that are not finite")
    return array


def _data_of(path: Path, key: str, matrix: Mapping[str, Any]) -> Any:
    """The values of a matrix, as many as its size says where it says one."""
    data = matrix.get("data", matrix)
    data = data.split() if isinstance(data, str) else data
    if isinstance(data, list) and "rows" in matrix and "cols" in matrix:
        channels = _CHANNELS.fullmatch(str(matrix.get("dt", "d")))
        try:
            rows, cols = int(matrix["rows"]), int(matrix["cols"])
        except (TypeError, ValueError, OverflowError):
            rows = cols = -1
        if channels is None or min(rows, cols) < 0 or rows * cols * int(channels[1] or 1) != len(data):
            raise FileFormatError(path, f"{key} is not of the size that its rows, cols and dt say")
    return data


def is_rotation(matrix: np.ndarray) -> bool:
    """Whether it is one but for rounding: files hold few digits."""
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() <= _ROUNDED and np.linalg.det(matrix) > 0)


class _BoundedLoader(yaml.SafeLoader):  # type: ignore[misc]  # PyYAML has no types
    """Counts values as they stand once aliases are replaced: a few lines of them can mean billions."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._count = self._depth = 0
        self._count_of: dict[str, int] = {}

    def compose_node(self, parent: Any, index: Any) -> Any:
        """The next node, with its depth, its size and what it stands for in bounds."""
        event, before = self.peek_event(), self._count
        anchor = event.anchor
        is_alias = isinstance(event, yaml.AliasEvent)
        if is_alias and anchor in self.anchors and anchor not in self._count_of:
            raise ValueError("an alias stands inside its own anchor")
        self._count += self._count_of.get(anchor, 0) if is_alias else 1
        self._depth += 1
        if self._count > _MOST_VALUES:
            raise ValueError(f"with its aliases it holds more than {_MOST_VALUES} values")
        if self._depth > _DEEPEST:
            raise ValueError(f"it is nested more than {_DEEPEST} deep")
        if isinstance(event, yaml.ScalarEvent) and len(event.value) > _LONGEST_VALUE:
            raise ValueError(f"a value has {len(event.value)} letters")
        node = super().compose_node(parent, index)
        self._depth -= 1
        if anchor is not None and not is_alias:
            self._count_of[anchor] = self._count - before
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        """Names and values; of a name that is there twice, one value would be skipped."""
        names = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        twice = next((name for name, count in Counter(names).items() if count > 1 and name != "<<"), None)
        if twice is not None:
            raise ValueError(f"the key {twice[:80]} is there twice")
        return super().construct_mapping(node, deep)


def yaml_values(text: str) -> Any:
    """What a YAML text holds.

    Raises:
        ValueError: it is none, or is larger, deeper or of more values than any calibration.
    """
    if len(text) > _MOST_YAML:
        raise ValueError(f"it has more than {_MOST_YAML} letters")
    try:
        loader = _BoundedLoader(text)
        try:
            return loader.get_single_data()
        finally:
            loader.dispose()
    except (yaml.YAMLError, LookupError, AttributeError, TypeError, ArithmeticError, RecursionError) as error:
        # PyYAML's own constructors raise what they stumble over: `!!int ''` is an IndexError.
        raise ValueError(str(error) or type(error).__name__) from error


def xml_values(data: bytes) -> dict[str, Any]:
    """Numbers and words of an OpenCV XML file by name, a matrix as the words of its parts.

    OpenCV's own reader is not used: a damaged file ends it, and the process with it.

    Raises:
        ValueError: it is none, or defines entities, a few of which can mean billions of words.
    """
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise ValueError("it defines entities")
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, LookupError) as error:
        raise ValueError(str(error)) from error
    if root.tag != "opencv_storage":
        raise ValueError(f"it begins with <{root.tag[:20]}>, not <opencv_storage>")
    tags = [node.tag for node in root]
    twice = next((tag for tag, count in Counter(tags).items() if count > 1), None)
    if twice is not None:
        raise ValueError(f"the key {twice[:80]} is there twice")
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
    """Width and height of images.

    Raises:
        FileFormatError: they are no sizes.
    """
    if not (1 <= width <= _MOST_PIXELS and 1 <= height <= _MOST_PIXELS):
        raise FileFormatError(path, f"images of {width:g} x {height:g} pixels cannot be")
    return int(width), int(height)
