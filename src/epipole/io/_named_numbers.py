"""Numbers under a key of a file that was read into names and values."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from epipole.errors import FileFormatError

_MOST_PIXELS = 1 << 20  # along a side
_ROUNDED = 1e-4


def numbers_of(path: Path, content: Mapping[str, Any], key: str, *shape: int) -> np.ndarray:
    """A matrix (a vector where no shape is given), however it is written: lists, a `data` list, or words in a line.

    Raises:
        FileFormatError: the key is missing, or holds something else.
    """
    if key not in content:
        raise FileFormatError(path, f"the key {key} is missing")
    value = content[key]
    if isinstance(value, Mapping):
        value = value.get("data", value)
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


def is_rotation(matrix: np.ndarray) -> bool:
    """Whether it is one but for rounding: files hold few digits."""
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() <= _ROUNDED and np.linalg.det(matrix) > 0)


def yaml_values(text: str) -> Any:
    """What a YAML text holds.

    Raises:
        ValueError: it is none, or an alias stands inside of what has an anchor: a few such lines can mean billions of
            values.
    """
    depth = 0  # of collections, from one that has an anchor on
    try:
        for event in yaml.parse(text, Loader=yaml.SafeLoader):
            if isinstance(event, yaml.AliasEvent) and depth:
                raise ValueError("an alias stands inside an anchor")
            if isinstance(event, yaml.CollectionStartEvent):
                depth += bool(depth or event.anchor)
            elif isinstance(event, yaml.CollectionEndEvent):
                depth -= bool(depth)
        return yaml.safe_load(text)
    except (yaml.YAMLError, LookupError, AttributeError, TypeError, ArithmeticError, RecursionError) as error:
        # PyYAML's own constructors raise what they stumble over: `!!int ''` is an IndexError.
        raise ValueError(str(error) or type(error).__name__) from error


def xml_values(data: bytes) -> dict[str, Any]:
    """Numbers and words of an OpenCV XML file by name, a matrix as the words of its data.

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
    return {node.tag: _xml_value(node) for node in root}


def _xml_value(node: ElementTree.Element) -> float | str:
    matrix = node.find("data")
    text = (node if matrix is None else matrix).text or ""
    try:
        return float(text)
    except ValueError:
        return text.strip()


def size_of(path: Path, width: float, height: float) -> tuple[int, int]:
    """Width and height of pictures.

    Raises:
        FileFormatError: they are no sizes.
    """
    if not (1 <= width <= _MOST_PIXELS and 1 <= height <= _MOST_PIXELS):
        raise FileFormatError(path, f"pictures of {width:g} x {height:g} pixels cannot be")
    return int(width), int(height)
