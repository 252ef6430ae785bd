"""Generates the benchmark pages: one per family of files in benchmarks/results, and the protocol."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmark_tables import Column, Measure, flat, machine_line, medians, standing, table

RESULTS = Path(__file__).resolve().parents[2] / "benchmarks" / "results"
HEAD = """# Benchmarks

These pages are generated from `benchmarks/results` and show all numbers, including those where other programs are better. The
[protocol](protocol.md) describes what is measured and how. If a file has several runs, the values are medians. A table below each
comparison lists the programs than which epipole is better, level (within 2 %) or worse. Each section names its file, machine, versions and
commit. Small differences between sections of different days are not significant.

| page | files |
|---|---|
"""
SFM_COLUMNS = (
    Column("registered", "registered images"),
    *(
        Column("position_mean", "position error, mean, mm", 1000),
        Column("position_max", "position error, maximum, mm", 1000),
    ),
    Column("rotation_mean_deg", "rotation error, mean, degrees"),
    *(Column(f"auc_{n}", f"AUC at {n} degree{'s' * (n > 1)}, %", 100) for n in (1, 3, 5)),
    Column("gps_median_m", "to the GPS fixes, median, m"),
    Column("axis_to_motion_median_deg", "axis to motion, degrees"),
    *(Column("points", "points"), Column("observations", "observations")),
    *(Column("wall_s", "seconds"), Column("peak_memory_mb", "memory, MB")),
)
SFM_MEASURES = (
    Measure("registered", "registered images", higher_is_better=True),
    Measure("position_mean", "mean position error"),
    Measure("rotation_mean_deg", "mean rotation error"),
    Measure("auc_1", "AUC at 1 degree", higher_is_better=True),
    Measure("gps_median_m", "distance to the GPS fixes"),
    Measure("wall_s", "time"),
    Measure("peak_memory_mb", "memory"),
)
ERROR_UNITS = {"relative": "degrees", "absolute": "degrees", "fundamental": "px", "homography": "px"}


def sfm(content: Any) -> str:
    """Tables of structure-from-motion: medians of all runs of each program on one set."""
    rows = {
        name: {key: value["median"] for key, value in row.items()}
        for name, row in content["summary"].items()
        if name != "pycolmap-best"
    }
    summary = f"{content['pictures']} images; given to each program: {content['told']}."
    return "\n\n".join([summary, table(rows, SFM_COLUMNS), standing(rows, SFM_MEASURES)])


def estimation(content: Any) -> str:
    """Tables of one estimation task: times and errors of each program."""
    unit = ERROR_UNITS[content["task"].split("-")[0]]
    columns = (
        Column("median_ms", "time, median, ms"),
        Column("p90_ms", "time, 90th percentile, ms"),
        Column("median_error", f"error, median, {unit}"),
        Column("p90_error", f"error, 90th percentile, {unit}"),
        Column("failed", "failed"),
    )
    measures = (
        Measure("median_ms", "time"),
        Measure("median_error", "median error"),
        Measure("p90_error", "90th percentile of the error"),
        Measure("failed", "failures"),
    )
    summary = f"{content['problems']} problems, given to every program."
    return "\n\n".join(
        [summary, table(content["programs"], columns), standing(content["programs"], measures)]
    )


def bundle(content: Any) -> str:
    """Tables of bundle adjustment: time and cost of each program, one section per problem."""
    columns = (
        Column("seconds_solve", "solve time, s"),
        Column("seconds_build", "setup time, s"),
        Column("num_iterations", "iterations"),
        Column("final_cost", "final cost"),
    )
    measures = (Measure("seconds_solve", "solve time"), Measure("final_cost", "final cost"))
    parts = []
    for name, problem in content.items():
        if isinstance(problem, dict) and "programs" in problem:
            parts += [f"### {name}, {problem['observations']:,} observations"]
            parts += [table(problem["programs"], columns), standing(problem["programs"], measures)]
    return "\n\n".join(parts)


def slam(content: Any) -> str:
    """Tables of SLAM, one section per sensor: localized frames, errors, and time per frame."""
    if "summary" not in content:
        return anything(content)
    sensors = dict.fromkeys(name.split()[0] for name in content["summary"])
    titles = {"rgbd": "depth camera", "stereo": "stereo", "mono": "one camera"}
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
        parts += [f"### {titles.get(sensor, sensor)}", *_slam_tables(rows, sensor)]
    return "\n\n".join(parts)


def _slam_tables(rows: Mapping[str, Mapping[str, Any]], sensor: str) -> list[str]:
    aligned = "sim3_m" if sensor == "mono" else "se3_m"
    keys = dict.fromkeys(key for row in rows.values() for key in row)
    errors = [k for k in keys if k.endswith((aligned, "made_up_max", "turn_max_deg"))]
    columns = [Column("runs", "runs")]
    measures = []
    for variant, label in (("final", "final trajectory"), ("causal", "causal poses")):
        columns.append(Column(f"{variant} coverage", f"{label}: localized frames, %", 100))
        measures.append(Measure(f"{variant} coverage", f"{label}: localized frames", higher_is_better=True))
        for key in (k for k in errors if k.startswith(variant)):
            truth, kind = key.split()[1], key.split()[2]
            against = "" if truth == "exact" else f" against {truth}"
            heading, measure, factor = {
                aligned: ("position error, RMS, mm", "position error", 1000.0),
                "made_up_max": ("spurious translation, maximum", "spurious translation", 1.0),
                "turn_max_deg": ("rotation error, maximum, degrees", "rotation error", 1.0),
            }[kind]
            columns.append(Column(key, f"{label}: {heading}{against}", factor))
            measures.append(Measure(key, f"{label}: {measure}{against}"))
    columns += [
        Column("ms_median", "time per frame, median, ms"),
        Column("ms_p95", "time per frame, 95th percentile, ms"),
    ]
    measures += [
        Measure("ms_median", "time per frame, median"),
        Measure("ms_p95", "time per frame, 95th percentile"),
    ]
    return [table(rows, columns), standing(rows, measures)]


def splats(content: Any) -> str:
    """Table of radiance fields: medians over the seeds of each training."""
    columns = (
        Column("runs", "seeds"),
        *(Column("psnr", "PSNR, dB"), Column("ssim", "SSIM"), Column("steps", "steps")),
        *(Column("train_s", "training time, s"), Column("size", "Gaussians, parameters or grid corners")),
    )
    return table({name: medians(runs) for name, runs in content["tasks"].items()}, columns)


def compared(*measures: Measure) -> Callable[[Any], str]:
    """Renderer of sections with one row per program, compared by these measures."""

    def sections(content: Any) -> str:
        parts = []
        for name, rows in content.items():
            if name != "machine" and isinstance(rows, dict):
                parts += [f"### {name}", table(rows), standing(rows, measures)]
        return "\n\n".join(part for part in parts if part)

    return sections


def solvers(content: Any) -> str:
    """Table of the minimal solvers, compared with PoseLib where it has the same solver."""
    rows = {name: row for name, row in content.items() if isinstance(row, dict) and name != "machine"}
    shared = [row for row in rows.values() if "PoseLib call us" in row]
    faster = sum(row["call us"] < row["PoseLib call us"] for row in shared)
    right = sum(row["right"] >= row["PoseLib right"] for row in shared)
    summary = (
        f"{content['count']:,} exact problems per solver. PoseLib has {len(shared)} of these solvers. A call from Python is faster in epipole"
        f" for {faster} of them, and finds the true solution at least as often for {right}."
    )
    return "\n\n".join([summary, table(rows)])


def anything(content: Any) -> str:
    """Tables of a file of unknown layout, with its keys as headings."""
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
    """Result files that share a page."""

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
            Measure("density %", "density", higher_is_better=True),
            Measure("bad 1 %", "pixels with an error above 1 px"),
            Measure("bad 2 %", "pixels with an error above 2 px"),
            Measure("bad 1 % with holes", "pixels with an error above 1 px or without a disparity"),
            Measure("average px", "mean error"),
            SECONDS,
        ),
    ),
    Family("stereo_more", "Stereo: modes, error bars, depth", ("stereo_",)),
    Family("fields", "Radiance fields", ("splats.json",), splats),
    Family(
        "fields_more",
        "Radiance fields: speed and scaling",
        ("splat_", "rasterizer", "field_", "lesson_fields"),
    ),
    Family("pose_graphs", "Pose graphs", ("pose_graphs",), compared(SECONDS, Measure("cost", "final cost"))),
    Family(
        "many",
        "Image pairs and triangulation",
        ("throughput", "triangulation"),
        compared(
            Measure("all", "correctly classified pairs", higher_is_better=True),
            Measure("mean error", "mean error"),
            Measure("median error", "median error"),
            Measure("found", "triangulated points", higher_is_better=True),
            SECONDS,
        ),
    ),
    Family("solvers", "Minimal solvers", ("solvers",), solvers),
    Family(
        "calibration",
        "Calibration",
        ("calibration",),
        compared(Measure("rms px", "RMS of the residuals"), SECONDS),
    ),
    Family("scale", "Scale", ("anchors", "inertial")),
    Family("more", "Other measurements", ("",)),
)


def benchmark_pages(results: Path = RESULTS) -> dict[str, str]:
    """Markdown by path: the index, the protocol, and a page for each family that has files."""
    remaining = sorted(results.glob("*.json"))
    pages: dict[str, str] = {}
    rows = []
    for family in FAMILIES:
        files = [path for path in remaining if path.name.startswith(family.prefixes)]
        remaining = [path for path in remaining if path not in files]
        if files:
            parts = [f"# {family.title}", "The [protocol](protocol.md) describes what is measured and how."]
            for path in files:
                content = json.loads(path.read_text(encoding="utf-8"))
                parts += [f"## {_title(path.stem, family)}", machine_line(path.name, content)]
                parts.append(family.render(content))
            pages[f"benchmarks/{family.page}.md"] = "\n\n".join(part for part in parts if part) + "\n"
            rows.append(f"| [{family.title}]({family.page}.md) | {', '.join(f'`{p.name}`' for p in files)} |")
    protocol = (
        (results.parent / "README.md").read_text(encoding="utf-8").replace("# Benchmarks", "# Protocol", 1)
    )
    index = HEAD + "\n".join(rows) + "\n"
    return {"benchmarks/index.md": index, "benchmarks/protocol.md": protocol, **pages}


def _title(stem: str, family: Family) -> str:
    """File name without the prefix of its family."""
    short = next((stem.removeprefix(p) for p in family.prefixes if p and p.endswith("_")), stem)
    return short.replace("_", " ")
