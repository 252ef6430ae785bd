"""Adds the generated pages to the site, and fills the navigation of mkdocs.yml.

There `+name` stands for all generated pages of a folder.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Any

from api_pages import api_pages
from benchmark_pages import benchmark_pages
from command_pages import command_pages
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from tutorial_pages import tutorial_pages


def generated() -> dict[str, str]:
    """Markdown of all generated pages by path, in the order of the navigation."""
    return {**tutorial_pages(), **command_pages(), **api_pages(), **benchmark_pages()}


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Make the pages, and put them in the places of the navigation that ask for them."""
    config.extra["generated"] = generated()
    config.nav = _filled(config.nav, list(config.extra["generated"]))
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages to those on disk."""
    for path, text in config.extra.pop("generated").items():
        files.append(File.generated(config, path, content=text))
    return files


def on_post_build(config: MkDocsConfig) -> None:
    """Write the search index as a script, too: pages opened from disk may not fetch files."""
    folder = Path(config.site_dir) / "search"
    index = (folder / "search_index.json").read_text(encoding="utf-8")
    (folder / "search_index.js").write_text(f"var __index = {index}", encoding="utf-8")


def _filled(entries: Any, pages: list[str]) -> list[Any]:
    """Navigation with all marks replaced."""
    found: list[Any] = []
    for entry in entries:
        title, value = next(iter(entry.items())) if isinstance(entry, dict) else (None, entry)
        if isinstance(value, list):
            value = _filled(value, pages)
        elif value.startswith("+"):
            found += [path for path in pages if PurePosixPath(path).parent.name == value[1:]]
            continue
        found.append({title: value} if title else value)
    return found
