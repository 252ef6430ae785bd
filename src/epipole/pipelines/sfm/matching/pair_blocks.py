"""Pairs of images in blocks, one file each, with a key for every pair.

Adding or removing an image shifts the blocks. Therefore a block reuses results of pairs from files of earlier lists,
and computes only the others.
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


def block_slices(num_pairs: int) -> list[slice]:
    """Consecutive pairs, divided into blocks."""
    size = max(1, min(MOST_BLOCK_PAIRS, -(-num_pairs // MOST_BLOCKS)))
    return [slice(start, start + size) for start in range(0, num_pairs, size)]


def block_units(
    pairs: Sequence[tuple[int, int]],
    keys: Sequence[str],
    folder: Path,
    work: Callable[[PairBlock], Arrays],
    table: Table,
    task_of: Callable[[slice], Any],
) -> list[Unit]:
    """Units for blocks of pairs.

    Args:
        pairs: pairs of images, sorted.
        keys: digest of everything that the result of each pair depends on.
        folder: folder of the files, including those with earlier results.
        work: function that makes the file of a block.
        table: arrays of this file.
        task_of: gives the input for the pairs of a slice.
    """
    slices = block_slices(len(pairs))
    names = [f"{digest(list(keys[block]))}.npz" for block in slices]
    blocks = (
        _blocks_in(folder, {*names}, table) if not all((folder / name).exists() for name in names) else {}
    )
    units = []
    for block, name in zip(slices, names):
        positions = {n: blocks[key] for n, key in enumerate(keys[block]) if key in blocks}
        payload = PairBlock(tuple(pairs[block]), tuple(keys[block]), positions, table, task_of(block))
        units.append(Unit(folder / name, Path(name).stem, work, payload, len(payload.pairs)))
    return units


def _blocks_in(folder: Path, planned: set[str], table: Table) -> dict[str, tuple[Path, int]]:
    """File and row of existing results, by the key of the pair."""
    blocks: dict[str, tuple[Path, int]] = {}
    for path in sorted(folder.glob("*.npz")):
        if path.name in planned or not is_done(path, stored_key(path)):
            continue
        try:
            keys = load(path, table)["pair_keys"]
        except WorkspaceError:  # another kind of file, or a damaged one
            continue
        blocks.update({str(key): (path, n) for n, key in enumerate(keys)})
    return blocks


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
