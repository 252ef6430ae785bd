"""Validation of an output folder's marker, which may come from anyone."""

from __future__ import annotations

from epipole.io.names import is_inside_name


def texts_of_mark(values: object) -> tuple[str, ...]:
    """Check a list of texts.

    Raises:
        TypeError: it is not a list.
    """
    if not isinstance(values, list):
        raise TypeError
    return tuple(str(value) for value in values)


def inside_name_of_mark(name: object) -> str:
    """Check the name of a result, which a later run may remove.

    Raises:
        ValueError: the name leads out of the folder.
    """
    if not isinstance(name, str) or not is_inside_name(name):
        raise ValueError
    return name
