"""Generates the API reference: one page per public package, with directives that mkdocstrings expands."""

from __future__ import annotations

import ast
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[2] / "src" / "epipole"
PACKAGES = (
    *("api", "cameras", "geometry", "solvers", "robust", "optim", "features", "image", "scene", "io"),
    *("metrics", "mapping", "dense", "scale", "inertial", "synthetic", "config", "errors"),
)
MODULES = {
    "calibration": ("features.boards", "io.calibration.files", "pipelines.calibration.calibrate"),
    "stereo": (
        *("disparity_search.rectification", "disparity_search.search"),
        *("pipelines.stereo.depth", "pipelines.stereo.calibration_error", "pipelines.stereo.uncalibrated"),
    ),
    "fields": (
        "fields.splat.rasterizer",
        "scene.gaussian_cloud",
        "io.gaussians.ply",
        "io.gaussians.files",
    ),
}
"""Modules outside the public packages that other pages refer to, by page."""
HEAD = """# API reference

`epipole.NAME` is the same as `epipole.api.NAME`: one function per task. The other packages contain the individual steps, which work
on plain arrays. `import epipole` is fast, because each name is imported on first use.

| page | |
|---|---|
"""


def api_pages() -> dict[str, str]:
    """Markdown of the API pages by path."""
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
        parts = [f"# Modules for {page}"]
        for module in modules:
            tree = _tree(module)
            parts += [f"## epipole.{module}", ast.get_docstring(tree) or ""]
            parts += [f"::: epipole.{module}.{name}" for name in _own_names(tree)]
        pages[f"api/of_{page}.md"] = "\n\n".join(parts) + "\n"
    return {"api/index.md": HEAD + "\n".join(rows) + "\n", **pages}


def _described(package: str, paths: list[str]) -> list[str]:
    """Directives for names of this package, and links to names that another package documents."""
    elsewhere = [p for p in paths if (home := p.split(".")[1]) in PACKAGES and home != package]
    links = ", ".join(f"[`{path.rsplit('.', 1)[1]}`][{path}]" for path in elsewhere)
    here = [f"::: {path}" for path in paths if path not in elsewhere]
    return [*([f"Also exported: {links}."] if links else []), *here]


def _tree(name: str) -> ast.Module:
    path = PACKAGE / name.replace(".", "/")
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return ast.parse(file.read_text(encoding="utf-8"))


def _names(name: str, tree: ast.Module) -> list[str]:
    """Dotted paths of the names that a package re-exports, or that a module defines."""
    exported = [
        f"{node.module}.{alias.name}"
        for node in tree.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname == alias.name
    ]
    return exported or [f"epipole.{name}.{own}" for own in _own_names(tree)]


def _own_names(tree: ast.Module) -> list[str]:
    kinds = (ast.FunctionDef, ast.ClassDef)
    return [node.name for node in tree.body if isinstance(node, kinds) and not node.name.startswith("_")]
