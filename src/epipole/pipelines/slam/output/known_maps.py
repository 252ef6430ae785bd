"""Maps of earlier runs in which SLAM continues: several are merged where they show a common area."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from epipole.errors import ConfigError
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.frames import SlamCamera
from epipole.pipelines.slam.loops.merging import merge_maps
from epipole.pipelines.slam.map.slam_map import SlamMap
from epipole.pipelines.slam.output.map_file import KnownMap, distinct_names, map_file_of, read_slam_map
from epipole.runs import Progress, ProgressCallback


class KnownMaps(NamedTuple):
    """Maps of earlier runs."""

    first: KnownMap
    """The first map and what could be merged with it, with the names and numbers of the keyframes of all maps."""
    separate: dict[str, SlamMap]
    """The others, by file: a loop closure may join them to the first."""
    notes: tuple[str, ...]
    numbers: dict[str, frozenset[int]]
    """Frame numbers of the keyframes of each separate map."""

    @property
    def models(self) -> list[SlamMap]:
        """All maps, the first one first."""
        return [self.first.model, *self.separate.values()]


def read_known_maps(
    paths: Sequence[Path], sensor: SlamCamera, config: SlamConfig, progress: ProgressCallback
) -> KnownMaps | None:
    """Read maps, and merge those that show a common area, in the world of the first one; None without paths.

    Args:
        paths: output folders of earlier runs.
        sensor: the camera to localize in the maps.
        config: options of tracking and mapping.
        progress: called for each map to merge.

    Raises:
        FileFormatError: a file is not a map, or damaged.
        ConfigError: a map was made with another camera, the maps have no common unit, or one is given twice.
    """
    if not paths:
        return None
    if len({map_file_of(path).resolve() for path in paths}) < len(paths):
        raise ConfigError(f"a map is given twice: {', '.join(map(str, paths))}")
    maps = [read_slam_map(path, sensor) for path in paths]
    first, waiting, notes = maps[0], dict(zip(map(str, paths[1:]), maps[1:])), list[str]()
    for path, known in waiting.items():
        if known.is_metric and not first.is_metric:
            raise ConfigError(
                f"the map {paths[0]} is up to scale, but {path} is metric: pass the metric map first"
            )
    reasons: dict[str, str] = {}
    tried = 0
    while len(reasons) < len(waiting):
        path = next(path for path in waiting if path not in reasons)
        progress(Progress("merge", tried, len(paths) - 1))
        merged = merge_maps(first.model, waiting[path].model, sensor, config)
        tried = min(tried + 1, len(paths) - 2)
        if not merged.success:
            reasons[path] = merged.reason
            continue
        first, reasons = _with(first, path, waiting.pop(path), merged.number_offset, merged.model), {}
        notes.append(f"the map {path} was merged with {paths[0]}: they show a common area")
    if len(paths) > 1:
        progress(Progress("merge", len(paths) - 1, len(paths) - 1))
    for path, reason in reasons.items():
        notes.append(f"the map {path} is separate from {paths[0]} until frames connect them: {reason}")
        offset = 1 + max(first.numbers) - min(waiting[path].numbers)
        for keyframe in waiting[path].model.keyframes:
            keyframe.number += offset
        first = _with(first, path, waiting[path], offset, first.model)
    separate = {path: known.model for path, known in waiting.items()}
    numbers = {path: frozenset(k.number for k in model.keyframes) for path, model in separate.items()}
    return KnownMaps(first, separate, tuple(notes), numbers)


def _with(first: KnownMap, path: str, second: KnownMap, offset: int, model: SlamMap) -> KnownMap:
    """The first map with this model, and with the keyframes of the second one, from a path; their numbers increase by an offset."""
    file = Path(path).resolve()  # "." and ".." have no name
    folder = (file.stem if file.is_file() else file.name) or "map"
    return first._replace(
        model=model,
        names=first.names + distinct_names(second.names, set(first.names), folder),
        numbers=first.numbers + tuple(number + offset for number in second.numbers),
    )
