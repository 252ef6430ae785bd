"""MkDocs hooks that add the generated pages to the site and to the navigation.

In the navigation of mkdocs.yml, `+name` stands for all generated pages of the folder `name`.
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

from epipole.lesson.pages import lesson_pages

LATER = "---\nsearch:\n  boost: 0.3\n---\n"
"""Of pages that the search lists after the others: words of guides are names in the API, too."""


def generated() -> dict[str, str]:
    """Markdown of all generated pages by path, in navigation order."""
    return {**tutorial_pages(), **command_pages(), **api_pages(), **benchmark_pages()}


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Generate the pages and replace the `+name` entries of the navigation."""
    config.extra["generated"] = generated()
    config.nav = _filled(config.nav, list(config.extra["generated"]))
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages to the files on disk."""
    for path, text in config.extra.pop("generated").items():
        files.append(File.generated(config, path, content=(LATER if path.startswith("api/") else "") + text))
    return files


def on_post_build(config: MkDocsConfig) -> None:
    """Write the search index as a script, because pages opened from disk may not fetch files; and the lesson."""
    folder = Path(config.site_dir) / "search"
    index = (folder / "search_index.json").read_text(encoding="utf-8")
    (folder / "search_index.js").write_text(f"var __index = {index}", encoding="utf-8")
    lesson = Path(config.site_dir) / "lesson"
    lesson.mkdir(exist_ok=True)
    for name, page in lesson_pages().items():
        (lesson / name).write_text(page, encoding="utf-8")


def _filled(entries: Any, pages: list[str]) -> list[Any]:
    """Replace each `+name` entry by the pages of that folder."""
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
