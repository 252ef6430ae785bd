"""Checks of what the mark of an output folder holds: it may come from anyone."""

from __future__ import annotations

from epipole.io.names import is_inside_name


def texts_of_mark(values: object) -> tuple[str, ...]:
    """A list of texts.

    Raises:
        TypeError: it is none.
    """
    if not isinstance(values, list):
        raise TypeError
    return tuple(str(value) for value in values)


def inside_name_of_mark(name: object) -> str:
    """The name of a result, which may be removed one day.

    Raises:
        ValueError: it leads out of the folder.
    """
    if not isinstance(name, str) or not is_inside_name(name):
        raise ValueError
    return name
