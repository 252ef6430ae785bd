"""Descriptions of files in an image folder that are skipped."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

from epipole.errors import FileFormatError
from epipole.io.contents_in_words import what_it_is

KINDS_SHOWN = 6
_OUTPUT_MARKERS = ("config.json", "database.db")


def passed_over_in_words(folder: Path, others: Sequence[str], results: Sequence[Path]) -> list[str]:
    """One sentence for files that are not of a supported image format, and one for each skipped folder of results.

    Args:
        folder: the image folder.
        others: skipped files, relative to it.
        results: skipped folders of results in it.
    """
    return [*_other_files(folder, others), *(_folder_of_results(path, folder) for path in results)]


def _refuse_folder(error: OSError) -> None:
    """Raise for a folder that cannot be listed: it may contain half of the images."""
    raise FileFormatError(Path(error.filename), f"the folder cannot be listed: {error.strerror}")


def files_below(folder: Path, ignored: set[Path], results: list[Path]) -> Iterator[str]:
    """Names of all files below a folder; each folder is entered once (links may form circles).

    Folders of results are not entered; they are added to `results`.
    """
    entered: set[Path] = set()
    for here, sub_folders, files in os.walk(folder, followlinks=True, onerror=_refuse_folder):
        at = Path(here)
        real = at.resolve()
        is_output = at != folder and any(marker in files for marker in _OUTPUT_MARKERS)
        if is_output and real not in ignored:
            results.append(at)
        if real in entered or is_output or (real in ignored and at != folder):
            sub_folders.clear()
            continue
        entered.add(real)
        sub_folders[:] = sorted(s for s in sub_folders if not s.startswith(".") and s != "__MACOSX")
        yield from ((at / f).relative_to(folder).as_posix() for f in files if not f.startswith("."))


def _other_files(folder: Path, names: Sequence[str]) -> list[str]:
    if not names:
        return []
    by_suffix: dict[str, list[str]] = {}
    for name in names:
        by_suffix.setdefault(PurePosixPath(name).suffix.lower(), []).append(name)
    kinds = sorted(by_suffix.items(), key=lambda kind: (-len(kind[1]), kind[0]))
    words, are_images = [], False
    for suffix, own in kinds[:KINDS_SHOWN]:
        what = what_it_is(folder / own[0]).removeprefix("it is ")
        is_image = what.endswith("image")
        are_images |= is_image
        content = f", {what}" if is_image or what == "a video" else ""
        words.append(f"{len(own)} {suffix or 'without a suffix'} ({own[0]}{content})")
    if len(kinds) > KINDS_SHOWN:
        words.append(f"{sum(len(own) for _, own in kinds[KINDS_SHOWN:])} of other kinds")
    files = "1 file" if len(names) == 1 else f"{len(names)} files"
    advice = "; to use the images among them, convert or rename them to .jpg or .png" if are_images else ""
    return [f"Skipped {files} without a supported image suffix: {', '.join(words)}{advice}"]


def _folder_of_results(path: Path, folder: Path) -> str:
    suffixes = Counter(PurePosixPath(name).suffix.lower() for _, _, files in os.walk(path) for name in files)
    count = sum(suffixes.values())
    images = sum(suffixes[suffix] for suffix in (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".heic"))
    marker = next((name for name in _OUTPUT_MARKERS if (path / name).is_file()), "results")
    return (
        f"Skipped the folder {path.relative_to(folder).as_posix()} ({count} {'file' if count == 1 else 'files'}, "
        f"{images} of them images): its {marker} marks it as results of an earlier run. To use the images, move that file away"
    )
