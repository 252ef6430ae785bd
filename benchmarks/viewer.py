"""Loading time and frame time of the viewer with large point clouds, without a GPU.

    python -m benchmarks.viewer [--points N ...]

The browser is headless Chromium with software WebGL (SwiftShader) on the same cores; the benchmark needs Playwright and Chromium.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

import epipole
from benchmarks.measure import describe_machine
from epipole.io.meshes.ply import write_points_ply

RESULTS = Path(__file__).parent / "results" / "viewer.json"
SIZE = (1200, 800)
SOFTWARE_GL = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)
NUM_FRAMES = 150
"""Frames while the camera rotates around the cloud."""
NUM_SKIPPED = 30
"""First frames, which are not counted because the viewer still adapts the number of points."""
ROTATE = """async ([frames, skipped]) => {
  const canvas = document.getElementById("space"), { view } = await space, times = [], counts = [];
  for (let k = 0, last = performance.now(); k < frames; k++) {
    view.jumpTo({ ...view.eye(), yaw: view.eye().yaw + 0.02 });
    await new Promise(requestAnimationFrame);
    const now = performance.now();
    if (k >= skipped) { times.push(now - last); counts.push(Number(canvas.dataset.points)); }
    last = now;
  }
  return [times, counts];
}"""
STATE = "[Number(document.getElementById('space').dataset.points || 0), document.getElementById('space').dataset.settled]"


def cloud(path: Path, n: int) -> None:
    """Write a wavy ring of `n` points with colors."""
    rng = np.random.default_rng(0)
    around, up = rng.uniform(0, 2 * np.pi, n), rng.uniform(-1, 1, n)
    radius = 3 + 0.3 * np.sin(5 * around) + 0.2 * np.cos(21 * up)
    flat = radius * np.sqrt(1 - 0.5 * up**2)
    xyz = np.stack([flat * np.cos(around), flat * np.sin(around), 3 * up], axis=1)
    rgb = 127 + 120 * np.sin(np.stack([3 * around, 9 * up, around + up], axis=1))
    write_points_ply(path, xyz, rgb.astype(np.uint8))


def measured(browser: Any, path: Path) -> dict[str, float]:
    """Open a file once, rotate the camera around it, and measure both."""
    start = time.perf_counter()
    handle = epipole.view(path, block=False)
    served = time.perf_counter()
    page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
    page.goto(handle.url)
    found: dict[str, float] = {"read_s": served - start}
    while "all_s" not in found:
        points, is_complete = page.evaluate(STATE)
        if points and "first_picture_s" not in found:
            found["first_picture_s"] = time.perf_counter() - served
        if is_complete == "yes":
            found["all_s"] = time.perf_counter() - served
        time.sleep(0.01)
    times, counts = page.evaluate(ROTATE, [NUM_FRAMES, NUM_SKIPPED])
    page.close()
    handle.stop()
    return found | {
        "frame_ms": statistics.median(times),
        "frame_ms_p95": float(np.percentile(times, 95)),
        "points_a_frame": statistics.median(counts),
    }


def main() -> None:
    """Measure, print the table and write the results."""
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, nargs="+", default=[100_000, 1_000_000, 5_000_000])
    parser.add_argument("--runs", type=int, default=3)
    arguments = parser.parse_args()
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    rows = []
    for n in arguments.points:
        with tempfile.TemporaryDirectory(prefix="epipole-viewer-") as folder, sync_playwright() as started:
            path = Path(folder) / "cloud.ply"
            cloud(path, n)
            browser = started.chromium.launch(executable_path=chromium, args=list(SOFTWARE_GL))
            runs = [measured(browser, path) for _ in range(arguments.runs)]
            browser.close()
        rows.append({"points": n} | {name: statistics.median(run[name] for run in runs) for name in runs[0]})
    content = {"machine": describe_machine(2), "window": SIZE, "num_runs": arguments.runs, "clouds": rows}
    RESULTS.write_text(json.dumps(content, indent=1) + "\n")
    headings = ("read, s", "first image, s", "all points, s", "ms per frame", "95 %", "points per frame")
    table = Table("points", *headings)
    for row in rows:
        seconds = (f"{row[name]:.2f}" for name in ("read_s", "first_picture_s", "all_s"))
        frames = (f"{row[name]:.0f}" for name in ("frame_ms", "frame_ms_p95"))
        table.add_row(f"{row['points']:,}", *seconds, *frames, f"{row['points_a_frame']:,.0f}")
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
