"""Pairs of images in blocks, one file each, with a key for every pair.

Adding or removing an image shifts the blocks. Therefore files of earlier lists stay where all their pairs are still
wanted, and a new block reuses results of pairs from the other files, and computes only the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from epipole._checks.tables import Arrays, Table
from epipole.errors import WorkspaceError
from epipole.runs import Unit, digest, is_done, load, stored_key

PairResult = Arrays
"""Result of one pair: `matches` (m, 2), and further arrays or numbers."""

MOST_BLOCKS, MOST_BLOCK_PAIRS = 64, 64
"""Approximate number of blocks, and pairs per block at most: enough for many workers, but not too many files."""
LEAST_BLOCKS = 8
"""Approximate number of blocks of the pairs that are added to earlier ones, at least."""


@dataclass(frozen=True, slots=True, eq=False)
class PairBlock:
    """Input of the unit of one block."""

    pairs: tuple[tuple[int, int], ...]
    keys: tuple[str, ...]
    """Digest of everything that the result of each pair depends on."""
    blocks: dict[int, tuple[Path, int]]
    """File and row of pairs whose results exist already."""
    table: Table
    """Arrays of the block's file and of the files in `blocks`."""
    task: Any
    """Input for computing the other pairs."""


def block_units(
    pairs: Sequence[tuple[int, int]],
    keys: Sequence[str],
    folder: Path,
    work: Callable[[PairBlock], Arrays],
    table: Table,
    task_of: Callable[[Sequence[int]], Any],
    blocks: Sequence[Sequence[int]] | None = None,
) -> list[Unit]:
    """Units for blocks of pairs.

    Args:
        pairs: pairs of images, sorted.
        keys: digest of everything that the result of each pair depends on.
        folder: folder of the files, including those with earlier results.
        work: function that makes the file of a block.
        table: arrays of this file.
        task_of: gives the input for the pairs with the given indices.
        blocks: indices of the pairs of each block; as the files of earlier results suggest if None.
    """
    if blocks is None:
        blocks = _divided(keys, folder, table)
    names = [digest([keys[n] for n in block]) for block in blocks]
    is_complete = all((folder / f"{name}.npz").exists() for name in names)
    earlier = {} if is_complete else _earlier_results(folder, {*names}, table)
    units = []
    for block, name in zip(blocks, names):
        of_block = tuple(keys[n] for n in block)
        found = {n: earlier[key] for n, key in enumerate(of_block) if key in earlier}
        payload = PairBlock(tuple(pairs[n] for n in block), of_block, found, table, task_of(block))
        units.append(Unit(folder / f"{name}.npz", name, work, payload, len(block)))
    return units


def _divided(keys: Sequence[str], folder: Path, table: Table) -> list[Sequence[int]]:
    """Indices of the pairs of each block: those of an earlier file whose pairs are all wanted stay together.

    Small files are divided again, so that repeated additions of few images do not leave many of them.
    """
    size = max(1, min(MOST_BLOCK_PAIRS, -(-len(keys) // MOST_BLOCKS)))
    even = _consecutive(range(len(keys)), size)
    row = {key: n for n, key in enumerate(keys)}
    if len(row) < len(keys):  # the same image twice
        return even
    if all((folder / f"{digest([keys[n] for n in block])}.npz").exists() for block in even):
        return even
    kept: list[Sequence[int]] = []
    for path in sorted(folder.glob("*.npz")):
        stored = _stored_keys(path, table)
        is_wanted = row.keys() >= {*stored} and len({*stored}) == len(stored)
        if 2 * len(stored) >= size and digest(stored) == path.stem and is_wanted:
            kept.append([row.pop(key) for key in stored])
    if not kept:
        return even
    rest = sorted(row.values())
    few = max(1, min(size, -(-len(rest) // LEAST_BLOCKS)))
    return sorted([*kept, *_consecutive(rest, few)], key=min)


def _consecutive(indices: Sequence[int], size: int) -> list[Sequence[int]]:
    return [indices[start : start + size] for start in range(0, len(indices), size)]


def _stored_keys(path: Path, table: Table) -> list[str]:
    """Keys of the pairs in a file; none if it is of another kind, or damaged."""
    try:
        return [str(key) for key in load(path, table, "pair_keys")["pair_keys"]]
    except WorkspaceError:
        return []


def _earlier_results(folder: Path, planned: set[str], table: Table) -> dict[str, tuple[Path, int]]:
    """File and row of existing results in other files than the planned ones, by the key of the pair."""
    found: dict[str, tuple[Path, int]] = {}
    for path in sorted(folder.glob("*.npz")):
        if path.stem not in planned and is_done(path, stored_key(path)):
            found.update({key: (path, n) for n, key in enumerate(_stored_keys(path, table))})
    return found


def filled(block: PairBlock, make: Callable[[list[int]], Sequence[PairResult]]) -> Arrays:
    """Make the file of a block.

    Args:
        block: the block.
        make: computes the pairs with the given indices in the block, which have no result yet.
    """
    results: dict[int, PairResult] = {}
    for path in {path: None for path, _ in block.blocks.values()}:
        stored = load(path, block.table)
        results.update({n: result_of(stored, row) for n, (at, row) in block.blocks.items() if at == path})
    missing = [n for n in range(len(block.pairs)) if n not in results]
    if missing:
        results.update(zip(missing, make(missing)))
    in_order = [results[n] for n in range(len(block.pairs))]
    matches = [np.asarray(result["matches"], np.int32) for result in in_order]
    others = [name for name in in_order[0] if name != "matches"]
    return {
        "pair_keys": np.array(block.keys, np.str_),
        "offsets": np.cumsum([0, *map(len, matches)]).astype(np.int64),
        "matches": np.concatenate(matches).reshape(-1, 2),
        **{name: np.stack([result[name] for result in in_order]) for name in others},
    }


def result_of(stored: Arrays, index: int) -> PairResult:
    """Result of one pair in a block's file."""
    others = [name for name in stored if name not in ("pair_keys", "offsets", "matches")]
    start, end = stored["offsets"][index : index + 2]
    return {"matches": stored["matches"][start:end], **{name: stored[name][index] for name in others}}
