"""Processing of many pairs: folders and stereo video."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from epipole.errors import EpipoleError, FileFormatError
from epipole.io.files import read_json
from epipole.io.images.video import is_video
from epipole.io.names import flat_names
from epipole.io.sequences.stereo_folders import pair_folders
from epipole.io.sequences.stereo_video import extract_pairs
from epipole.runs import Progress, ProgressCallback, ignore_progress, is_finished


@dataclass(frozen=True, slots=True, eq=False)
class StereoBatch:
    """Result of `stereo_many`."""

    out: Path
    done: tuple[str, ...]
    """Names of the pairs that were measured, which are also the names of their folders."""
    earlier: tuple[str, ...]
    """Names of the pairs measured by an earlier run with the same settings."""
    problems: dict[str, str]
    """Reasons why the others were not measured."""
    warnings: dict[str, tuple[str, ...]]
    """Warnings of the measured pairs, including those of earlier runs."""
    known: dict[str, float]
    """Fraction of known pixels of each."""

    def __repr__(self) -> str:
        return f"StereoBatch({len(self.done)} done, {len(self.earlier)} done earlier, {len(self.problems)} failed, in {self.out})"


def is_many(left: Path, right: Path) -> bool:
    """Whether these are folders or videos instead of two images."""
    return left.is_dir() or right.is_dir() or is_video(left) or is_video(right)


def list_pairs(
    left: Path, right: Path, out: Path, max_frames: int, progress: ProgressCallback = ignore_progress
) -> dict[str, tuple[Path, Path]]:
    """Pairs of two folders, by name if the names agree, else by order; or of stereo video. Files may be missing.

    Raises:
        FileFormatError: there are none, or the folders do not match.
    """
    if is_video(left) or is_video(right):
        pairs = extract_pairs(
            left,
            right,
            out / "frames",
            max_frames,
            lambda done, total: progress(Progress("video", done, total)),
        )
        return {a.stem: (a, b) for a, b in pairs}
    for folder in (left, right):
        if not folder.is_dir():
            raise FileFormatError(
                folder, "it is not a folder but the other one is: pass two images, two folders or two videos"
            )
    found = pair_folders(left, right, ignore=[out])
    return _by_folder([pair for _, pair in found], [name for name, _ in found])


def is_measured(
    folder: Path, pair: tuple[Path, Path], settings: Callable[[Path, Path], dict[str, Any]]
) -> bool:
    """Whether a pair was measured into this folder by an earlier run, with the same files and settings."""
    return all(image.is_file() for image in pair) and is_finished(folder, settings(*pair))


def run_batch(
    pairs: Mapping[str, tuple[Path, Path]],
    waiting: Collection[str],
    out: Path,
    measure: Callable[[Path, Path, Path], dict[str, Any]],
    progress: ProgressCallback = ignore_progress,
) -> StereoBatch:
    """Measure each pair into a folder of its name; a pair that fails does not stop the others.

    Args:
        pairs: from `list_pairs`.
        waiting: names of those to measure; the others were measured earlier.
        out: parent folder of the results.
        measure: called with (left, right, folder); returns the pair's summary.
        progress: called after each pair.
    """
    done, earlier = [], []
    problems: dict[str, str] = {}
    warnings: dict[str, tuple[str, ...]] = {}
    known: dict[str, float] = {}
    for number, (name, (left, right)) in enumerate(pairs.items(), 1):
        if name not in waiting:
            earlier.append(name)
        else:
            try:
                summary = measure(left, right, out / name)
                done.append(name)
                known[name] = summary["density"]
                if summary["warnings"]:
                    warnings[name] = tuple(summary["warnings"])
            except EpipoleError as error:
                problems[name] = str(error)
        progress(Progress("pairs", number, len(pairs)))
    return StereoBatch(out, tuple(done), tuple(earlier), problems, warnings, known)


def summary_of(
    batch: StereoBatch, pairs: dict[str, tuple[Path, Path]], before: dict[str, Any]
) -> dict[str, Any]:
    """The summary of many pairs, including those of earlier runs."""
    kept = {
        part: {n: v for n, v in before.get(part, {}).items() if n in batch.earlier}
        for part in ("known", "warnings")
    }
    warned = {n: tuple(map(str, words)) for n, words in kept["warnings"].items() if isinstance(words, list)}
    return {
        "done": [*batch.earlier, *batch.done],
        "known": kept["known"] | batch.known,
        "warnings": warned | batch.warnings,
        "problems": batch.problems,
        "images": {name: [str(a), str(b)] for name, (a, b) in pairs.items()},
    }


def read_summary(out: Path) -> dict[str, Any]:
    """The summary of an earlier run over many pairs; empty if missing or damaged."""
    try:
        content = read_json(out / "summary.json", allow_nan=True)
    except FileFormatError:
        return {}
    tables = ("known", "warnings", "problems", "images")
    is_valid = isinstance(content, dict) and all(isinstance(content.get(part, {}), dict) for part in tables)
    return content if is_valid and isinstance(content.get("done", []), list) else {}


def _by_folder(pairs: Sequence[tuple[Path, Path]], names: Sequence[str]) -> dict[str, tuple[Path, Path]]:
    """Pairs by unique name without suffix; subfolders are kept."""
    short = [Path(name).with_suffix("").as_posix() for name in names]
    count = Counter(own.casefold() for own in short)
    keys = [
        own if count[own.casefold()] == 1 else flat
        for own, flat in zip(short, flat_names(names), strict=True)
    ]
    return dict(zip(keys, pairs, strict=True))
