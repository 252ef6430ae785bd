"""Formats the numbers and tables of the benchmark pages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

LEVEL = 0.02
"""Largest difference of two equal results, relative to the larger value."""
OURS = "epipole"
NOT_COMPARED = {("PoseLib (pose alone)", "all"), ("pycolmap, 20000 points", "seconds")}
"""Pairs of program and measure that are not comparable: a missing feature, or a different number of items."""
Rows = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class Column:
    """Column of a table: key of the value, heading, and unit conversion factor."""

    key: str
    heading: str
    factor: float = 1.0


@dataclass(frozen=True)
class Measure:
    """Value by which programs are compared."""

    key: str
    label: str
    higher_is_better: bool = False


def number(value: Any) -> str:
    """Format a value with up to four digits and thousands separators."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str):
        return value.replace("|", "\\|")
    if isinstance(value, list):
        return " to ".join(number(part) for part in value)
    if float(value).is_integer() and abs(value) < 1e15:
        return f"{int(value):,}"
    if abs(value) >= 1e7:
        return f"{value:.3g}"
    if abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.4g}" if abs(value) >= 1 else f"{value:.3g}"


def flat(values: Any, prefix: str = "") -> dict[str, Any]:
    """Flatten nested dictionaries by joining their keys; skip lists of more than three numbers."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        name = f"{prefix} {key}".strip().replace("_", " ")
        if isinstance(value, Mapping):
            found |= flat(value, name)
        elif not isinstance(value, list):
            found[name] = value
        elif len(value) <= 3 and all(isinstance(part, int | float) for part in value):
            found[name] = value or None
    return found


def table(rows: Rows, columns: Sequence[Column] | None = None, first: str = "") -> str:
    """Markdown table with one line per row name; without `columns`, of all keys of all rows."""
    if columns is None:
        columns = [Column(key, key) for key in dict.fromkeys(key for row in rows.values() for key in row)]
    used = [c for c in columns if any(row.get(c.key) is not None for row in rows.values())]
    lines = [
        f"| {first} | " + " | ".join(c.heading.replace("|", "\\|") for c in used) + " |",
        "|---|" + "---:|" * len(used),
    ]
    lines += [
        f"| {name} | " + " | ".join(_scaled(row.get(c.key), c) for c in used) + " |"
        for name, row in rows.items()
    ]
    return "\n".join(lines)


def _scaled(value: Any, column: Column) -> str:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return number(value * column.factor if is_number and column.factor != 1.0 else value)


def standing(rows: Rows, measures: Sequence[Measure], ours: str | None = None) -> str:
    """Markdown table of the programs that epipole is better than, level with and worse than; empty without a comparison."""
    mine = ours or next((name for name in rows if name.startswith(OURS)), None)
    others = [name for name in rows if not name.startswith(OURS)]
    lines = []
    for measure in measures:
        own = None if mine is None else rows[mine].get(measure.key)
        if own is None:
            continue
        names: dict[str, list[str]] = {"better": [], "level": [], "worse": []}
        for name in others:
            theirs = rows[name].get(measure.key)
            if theirs is not None and (name, measure.key) not in NOT_COMPARED:
                names[_compare(own, theirs, measure)].append(name)
        if any(names.values()):
            lines.append(f"| {measure.label} | " + " | ".join(", ".join(v) for v in names.values()) + " |")
    if not lines:
        return ""
    return "\n".join([f"| {mine} is | better than | level with | worse than |", "|---|---|---|---|", *lines])


def _compare(own: float, theirs: float, measure: Measure) -> str:
    if abs(own - theirs) <= LEVEL * max(abs(own), abs(theirs)):
        return "level"
    return "better" if (own > theirs) == measure.higher_is_better else "worse"


def medians(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Median of each number over the runs, and the number of runs."""
    keys = dict.fromkeys(key for run in runs for key, value in run.items() if isinstance(value, int | float))
    found = {key: median(run[key] for run in runs if run.get(key) is not None) for key in keys}
    return {"runs": len(runs), **found}


def machine_line(name: str, content: Any) -> str:
    """Markdown line with the file, the machine, the versions and the commit of a result."""
    parts = [f"`benchmarks/results/{name}`"]
    machine = content.get("machine") if isinstance(content, dict) else None
    if machine:
        cores = f"{machine['cpus_usable']} processors" if machine.get("cpus_usable") else ""
        threads = (
            f"{machine['threads']} thread{'s' * (machine['threads'] > 1)}" if machine.get("threads") else ""
        )
        parts += [text for text in (machine.get("cpu", ""), cores, threads) if text]
        parts.append(f"Python {machine['python']}")
        parts += [f"{package} {version}" for package, version in machine.get("versions", {}).items()]
        commit = machine.get("commit") or ""
        parts.append(f"commit {commit[:10]}" + (" with changes" if commit.endswith("+") else ""))
    peers = {**content.get("versions", {}), **_versions_of_runs(content)} if isinstance(content, dict) else {}
    parts += [f"{peer} {version}" for peer, version in peers.items() if peer != OURS]
    return "*" + ", ".join(parts) + "*"


def _versions_of_runs(content: Mapping[str, Any]) -> dict[str, str]:
    runs = content.get("runs", ())
    return {run["program"]: run["version"] for run in runs if "program" in run and run.get("version")}
