"""The API reference: a page for each public package, with what its __init__ hands on; mkdocstrings writes the rest."""

from __future__ import annotations

import ast
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[2] / "src" / "epipole"
PACKAGES = (
    *("api", "cameras", "geometry", "solvers", "robust", "optim", "features", "image", "scene", "io"),
    *("metrics", "mapping", "scale", "inertial", "synthetic", "config", "errors"),
)
MODULES = {
    "calibration": ("features.boards", "io.calibration.files", "pipelines.calibration.calibrate"),
    "stereo": (
        *("disparity_search.rectification", "disparity_search.search"),
        *("pipelines.stereo.depth", "pipelines.stereo.calibration_error", "pipelines.stereo.uncalibrated"),
    ),
    "fields": ("fields.splat.rasterizer", "io.gaussians.ply", "io.gaussians.files", "dense.tsdf"),
}
"""Pages of single modules that the other pages speak of."""
HEAD = """# API reference

`import epipole` loads and compiles nothing; every name is imported on first use. `epipole.NAME` is `epipole.api.NAME`: one function
for each job. The other packages are the parts, on plain arrays.

| page | |
|---|---|
"""


def api_pages() -> dict[str, str]:
    """Markdown by path."""
    pages: dict[str, str] = {}
    rows = []
    for name in PACKAGES:
        tree = _tree(name)
        summary = (ast.get_docstring(tree) or "").splitlines()[0]
        rows.append(f"| [`epipole.{name}`]({name}.md) | {summary} |")
        parts = [f"# epipole.{name}", ast.get_docstring(tree) or ""]
        parts += _described(name, _names(name, tree))
        pages[f"api/{name}.md"] = "\n\n".join(parts) + "\n"
    for page, modules in MODULES.items():
        rows.append(f"| [{page}](of_{page}.md) | {', '.join(f'`epipole.{m}`' for m in modules)} |")
        parts = [f"# Modules of {page}"]
        for module in modules:
            tree = _tree(module)
            parts += [f"## epipole.{module}", ast.get_docstring(tree) or ""]
            parts += [f"::: epipole.{module}.{name}" for name in _own_names(tree)]
        pages[f"api/of_{page}.md"] = "\n\n".join(parts) + "\n"
    return {"api/index.md": HEAD + "\n".join(rows) + "\n", **pages}


def _described(package: str, positions: list[str]) -> list[str]:
    """What is at home here; what another page describes is a link."""
    elsewhere = [p for p in positions if (home := p.split(".")[1]) in PACKAGES and home != package]
    links = ", ".join(f"[`{position.rsplit('.', 1)[1]}`][{position}]" for position in elsewhere)
    here = [f"::: {position}" for position in positions if position not in elsewhere]
    return [*([f"From here, too: {links}."] if links else []), *here]


def _tree(name: str) -> ast.Module:
    path = PACKAGE / name.replace(".", "/")
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return ast.parse(file.read_text(encoding="utf-8"))


def _names(name: str, tree: ast.Module) -> list[str]:
    """Where the names stand that a package hands on; of a module its own."""
    handed_on = [
        f"{node.module}.{alias.name}"
        for node in tree.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname == alias.name
    ]
    return handed_on or [f"epipole.{name}.{own}" for own in _own_names(tree)]


def _own_names(tree: ast.Module) -> list[str]:
    kinds = (ast.FunctionDef, ast.ClassDef)
    return [node.name for node in tree.body if isinstance(node, kinds) and not node.name.startswith("_")]
