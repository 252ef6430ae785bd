"""The files that the input of a unit names, and the same input with other paths."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any


def with_paths(value: Any, change: Callable[[Path], Path]) -> Any:
    """Copy with each path changed, inside dataclasses, tuples, lists and the values of mappings too."""
    if isinstance(value, Path):
        return change(value)
    if is_dataclass(value) and not isinstance(value, type):
        parts = {field.name: getattr(value, field.name) for field in fields(value) if field.init}
        changed = {name: with_paths(part, change) for name, part in parts.items()}
        return replace(value, **{name: part for name, part in changed.items() if part is not parts[name]})
    if isinstance(value, tuple):
        items = [with_paths(item, change) for item in value]
        if all(new is old for new, old in zip(items, value)):
            return value
        return type(value)(*items) if hasattr(value, "_fields") else tuple(items)
    if isinstance(value, list):
        return [with_paths(item, change) for item in value]
    if isinstance(value, Mapping):
        return {key: with_paths(item, change) for key, item in value.items()}
    return value


def files_in(value: Any) -> list[Path]:
    """Existing files that a value names, each once; of a folder, all its files."""
    found: dict[Path, None] = {}

    def note(path: Path) -> Path:
        found.update(dict.fromkeys(_files_under(path)))
        return path

    with_paths(value, note)
    return list(found)


def _files_under(path: Path) -> Iterator[Path]:
    if path.is_file():
        yield path.absolute()
    elif path.is_dir():
        yield from (file.absolute() for file in sorted(path.rglob("*")) if file.is_file())
