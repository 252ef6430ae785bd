"""The pages of measured results, one for each family of files in benchmarks/results, and the protocol."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmark_tables import Column, Measure, flat, machine_line, medians, standing, table

RESULTS = Path(__file__).resolve().parents[2] / "benchmarks" / "results"
HEAD = """# Benchmarks

Every number that stands in `benchmarks/results`, losses included; these pages are made of those files. What is measured and how is
told in the [protocol](protocol.md). Values are medians where a file holds several runs. Under each comparison a table says with
which programs epipole is better, level (within 2 %) or worse, measure by measure. Each section names its file, the machine,
the versions and the commit: sections of different days are not comparable to the digit.

| page | files |
|---|---|
"""
SFM_COLUMNS = (
    Column("registered", "images placed"),
    *(Column("position_mean", "position error, mean, mm", 1000), Column("position_max", "largest, mm", 1000)),
    Column("rotation_mean_deg", "rotation error, mean, degrees"),
    *(Column(f"auc_{n}", f"AUC at {n} degree{'s' * (n > 1)}, %", 100) for n in (1, 3, 5)),
    Column("gps_median_m", "to the GPS fixes, median, m"),
    Column("axis_to_motion_median_deg", "axis to motion, degrees"),
    *(Column("points", "points"), Column("observations", "observations")),
    *(Column("wall_s", "seconds"), Column("peak_memory_mb", "memory, MB")),
)
SFM_MEASURES = (
    Measure("registered", "images placed", higher_is_better=True),
    Measure("position_mean", "mean position error"),
    Measure("rotation_mean_deg", "mean rotation error"),
    Measure("auc_1", "AUC at 1 degree", higher_is_better=True),
    Measure("gps_median_m", "distance to the GPS fixes"),
    Measure("wall_s", "time"),
    Measure("peak_memory_mb", "memory"),
)
ERROR_UNITS = {"relative": "degrees", "absolute": "degrees", "fundamental": "px", "homography": "px"}


def sfm(content: Any) -> str:
    """Medians of all runs of each program on one set."""
    rows = {
        name: {key: value["median"] for key, value in row.items()}
        for name, row in content["summary"].items()
        if name != "pycolmap-best"
    }
    given = f"{content['pictures']} images; the programs are told: {content['told']}."
    return "\n\n".join([given, table(rows, SFM_COLUMNS), standing(rows, SFM_MEASURES)])


def estimation(content: Any) -> str:
    """Times and errors of every program on one task."""
    unit = ERROR_UNITS[content["task"].split("-")[0]]
    columns = (
        Column("median_ms", "time, median, ms"),
        Column("p90_ms", "90 %, ms"),
        Column("median_error", f"error, median, {unit}"),
        Column("p90_error", f"90 %, {unit}"),
        Column("failed", "failed"),
    )
    measures = (
        Measure("median_ms", "time"),
        Measure("median_error", "median error"),
        Measure("p90_error", "error at 90 %"),
        Measure("failed", "failures"),
    )
    given = f"{content['problems']} problems, each sent to every program."
    return "\n\n".join([given, table(content["programs"], columns), standing(content["programs"], measures)])


def bundle(content: Any) -> str:
    """Time and cost of every adjuster, problem by problem."""
    columns = (
        Column("seconds_solve", "time of the solve, s"),
        Column("seconds_build", "of making the problem, s"),
        Column("num_iterations", "iterations"),
        Column("final_cost", "final cost"),
    )
    measures = (Measure("seconds_solve", "time of the solve"), Measure("final_cost", "final cost"))
    parts = []
    for name, problem in content.items():
        if isinstance(problem, dict) and "programs" in problem:
            parts += [f"### {name}, {problem['observations']:,} observations"]
            parts += [table(problem["programs"], columns), standing(problem["programs"], measures)]
    return "\n\n".join(parts)


def slam(content: Any) -> str:
    """Every sensor: how much of the path is known, how wrong it is, and the time of a frame."""
    if "summary" not in content:
        return anything(content)
    sensors = dict.fromkeys(name.split()[0] for name in content["summary"])
    words = {"rgbd": "depth camera", "stereo": "stereo", "mono": "one camera"}
    parts = []
    for sensor in sensors:
        rows = {
            name.split()[1]: {
                "runs": row["frames"].get("runs"),
                **{key: value["median"] for key, value in row.items()},
            }
            for name, row in content["summary"].items()
            if name.split()[0] == sensor
        }
        parts += [f"### {words.get(sensor, sensor)}", *_slam_tables(rows, sensor)]
    return "\n\n".join(parts)


def _slam_tables(rows: Mapping[str, Mapping[str, Any]], sensor: str) -> list[str]:
    aligned = "sim3_m" if sensor == "mono" else "se3_m"
    keys = dict.fromkeys(key for row in rows.values() for key in row)
    errors = [k for k in keys if k.endswith((aligned, "made_up_max", "turn_max_deg"))]
    columns = [Column("runs", "runs")]
    measures = []
    for when, words in (("final", "final path"), ("causal", "as frames came")):
        columns.append(Column(f"{when} coverage", f"{words}: frames with a place, %", 100))
        measures.append(Measure(f"{when} coverage", f"{words}: frames with a place", higher_is_better=True))
        for key in (k for k in errors if k.startswith(when)):
            truth, kind = key.split()[1], key.split()[2]
            against = "" if truth == "exact" else f" against {truth}"
            error, unit, factor = {
                aligned: ("error, rms, mm", "error", 1000.0),
                "made_up_max": ("place made up, at most", "place made up", 1.0),
                "turn_max_deg": ("error of the turn, at most, degrees", "error of the turn", 1.0),
            }[kind]
            columns.append(Column(key, f"{words}: {error}{against}", factor))
            measures.append(Measure(key, f"{words}: {unit}{against}"))
    columns += [Column("ms_median", "time of a frame, median, ms"), Column("ms_p95", "95 %, ms")]
    measures += [Measure("ms_median", "time of a frame, median"), Measure("ms_p95", "time of a frame, 95 %")]
    return [table(rows, columns), standing(rows, measures)]


def splats(content: Any) -> str:
    """Medians over the seeds of each training."""
    columns = (
        Column("runs", "seeds"),
        *(Column("psnr", "PSNR, dB"), Column("ssim", "SSIM"), Column("steps", "steps")),
        *(Column("train_s", "trained, s"), Column("size", "Gaussians, numbers or corners")),
    )
    return table({name: medians(runs) for name, runs in content["tasks"].items()}, columns)


def compared(*measures: Measure) -> Callable[[Any], str]:
    """Sections with a row for each program, compared by these measures."""

    def sections(content: Any) -> str:
        parts = []
        for name, rows in content.items():
            if name != "machine" and isinstance(rows, dict):
                parts += [f"### {name}", table(rows), standing(rows, measures)]
        return "\n\n".join(part for part in parts if part)

    return sections


def solvers(content: Any) -> str:
    """Each minimal solver, alone and beside PoseLib's where that has one."""
    rows = {name: row for name, row in content.items() if isinstance(row, dict) and name != "machine"}
    beside = [row for row in rows.values() if "PoseLib call us" in row]
    faster = sum(row["call us"] < row["PoseLib call us"] for row in beside)
    right = sum(row["right"] >= row["PoseLib right"] for row in beside)
    given = (
        f"{content['count']:,} exact problems each. A call from Python is faster than PoseLib's in {faster} of {len(beside)} solvers"
        f" that both have; the truth is among the answers at least as often in {right}."
    )
    return "\n\n".join([given, table(rows)])


def anything(content: Any) -> str:
    """Whatever a file holds: rows as tables, with headings for what they belong to."""
    content = {"": content} if isinstance(content, list) else content
    parts, single = [], {}
    for name, value in content.items():
        title = name.replace("_", " ")
        if name == "machine":
            continue
        if isinstance(value, dict) and value and all(isinstance(row, dict) for row in value.values()):
            parts += [f"### {title}", table({key: flat(row) for key, row in value.items()})]
        elif isinstance(value, list) and value and all(isinstance(row, dict) for row in value):
            rows = [flat(row) for row in value]
            names = [row.pop("name", row.pop("set", None)) for row in rows]
            keyed = {str(n if n is not None else k + 1): row for k, (n, row) in enumerate(zip(names, rows))}
            parts += [f"### {title}" if title != "rows" else "", table(keyed)]
        elif isinstance(value, dict):
            single[title] = flat(value)
        else:
            single |= {"": {**single.get("", {}), **flat({title: value})}}
    single = {name: row for name, row in single.items() if row}
    return "\n\n".join(part for part in [*([table(single)] if single else []), *parts] if part)


@dataclass(frozen=True)
class Family:
    """Files that share a page."""

    page: str
    title: str
    prefixes: tuple[str, ...]
    render: Callable[[Any], str] = anything


SECONDS = Measure("seconds", "time")
FAMILIES = (
    Family("sfm", "Structure-from-motion", ("sfm_",), sfm),
    Family("estimation", "Robust estimators", ("estimation_",), estimation),
    Family("bundle", "Bundle adjustment", ("bundle_",), bundle),
    Family("slam", "SLAM", ("slam_",), slam),
    Family(
        "stereo",
        "Stereo",
        ("stereo.json",),
        compared(
            Measure("density %", "share of pixels answered", higher_is_better=True),
            Measure("bad 1 %", "answers off by more than 1 px"),
            Measure("bad 2 %", "answers off by more than 2 px"),
            Measure("bad 1 % with holes", "off by more than 1 px, holes counted"),
            Measure("average px", "average error"),
            SECONDS,
        ),
    ),
    Family("stereo_more", "Stereo: modes, error bars, depth", ("stereo_",)),
    Family("fields", "Radiance fields", ("splats.json",), splats),
    Family(
        "fields_more",
        "Radiance fields: speed and growth",
        ("splat_", "rasterizer", "field_", "lesson_fields"),
    ),
    Family(
        "pose_graphs", "Pose graphs", ("pose_graphs",), compared(SECONDS, Measure("cost", "cost at the end"))
    ),
    Family(
        "many",
        "Many pairs, many points",
        ("throughput", "triangulation"),
        compared(
            Measure("all", "pairs explained rightly", higher_is_better=True),
            Measure("mean error", "mean error"),
            Measure("median error", "median error"),
            Measure("found", "points found", higher_is_better=True),
            SECONDS,
        ),
    ),
    Family("solvers", "Single solvers", ("solvers",), solvers),
    Family(
        "calibration",
        "Calibration",
        ("calibration",),
        compared(Measure("rms px", "rms of residuals"), SECONDS),
    ),
    Family("scale", "Scale", ("anchors", "inertial")),
    Family("more", "Other measurements", ("",)),
)


def benchmark_pages(results: Path = RESULTS) -> dict[str, str]:
    """Markdown by path: the list, the protocol, and a page for each family that has files."""
    left = sorted(results.glob("*.json"))
    pages: dict[str, str] = {}
    rows = []
    for family in FAMILIES:
        files = [path for path in left if path.name.startswith(family.prefixes)]
        left = [path for path in left if path not in files]
        if files:
            parts = [f"# {family.title}", "What is measured, and how: [protocol](protocol.md)."]
            for path in files:
                content = json.loads(path.read_text(encoding="utf-8"))
                parts += [f"## {_title(path.stem, family)}", machine_line(path.name, content)]
                parts.append(family.render(content))
            pages[f"benchmarks/{family.page}.md"] = "\n\n".join(part for part in parts if part) + "\n"
            rows.append(f"| [{family.title}]({family.page}.md) | {', '.join(f'`{p.name}`' for p in files)} |")
    protocol = (
        (results.parent / "README.md").read_text(encoding="utf-8").replace("# Benchmarks", "# Protocol", 1)
    )
    listed = HEAD + "\n".join(rows) + "\n"
    return {"benchmarks/index.md": listed, "benchmarks/protocol.md": protocol, **pages}


def _title(stem: str, family: Family) -> str:
    """The file's name without the words that the page's own title says."""
    short = next((stem.removeprefix(p) for p in family.prefixes if p and p.endswith("_")), stem)
    return short.replace("_", " ")
