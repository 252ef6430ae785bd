"""The pages of the lesson: each is a self-contained file made from a template, its texts and its script."""

from __future__ import annotations

import json
from functools import cache
from importlib import resources
from typing import Any, NamedTuple

import yaml
from markupsafe import Markup

from epipole.lesson.formulas import with_formulas
from epipole.lesson.scenes import scene_of
from epipole.report.frame import asset, render

PACKAGE = "epipole.lesson"
LANGUAGES = {"en": "English", "zh": "中文"}
STOP, COLON = {"en": ".", "zh": "。"}, {"en": ":", "zh": "\uff1a"}


class Page(NamedTuple):
    """The parts of a page; its template and texts are named after it."""

    name: str
    scripts: tuple[str, ...]
    """Scripts besides `widget.js`, in order."""
    is_recorded: bool = False
    """Whether its data were recorded from runs of the library, in `assets/NAME.json`."""


HOUSE = ("linear.js", "cameras.js", "house.js")
SPACE = (*HOUSE, "space.js")
PARTS = (*SPACE, "scene_parts.js")
SQUARES = ("eigen.js", "least_squares.js")
PAGES = (
    Page("disparity", ("disparity.js", "disparity_figures.js")),
    Page("epipolar", (*SPACE, "epipolar.js", "epipolar_figures.js")),
    Page("candidates", (*PARTS, "rays.js", "candidates.js", "candidates_figures.js")),
    Page("scale", (*PARTS, "scale.js", "scale_figures.js")),
    Page("triangulation", (*PARTS, *SQUARES, "rays.js", "triangulation.js", "triangulation_figures.js")),
    Page("pnp", (*PARTS, *SQUARES, "rays.js", "p3p.js", "pnp.js", "pnp_figures.js")),
    Page("models", (*SPACE, "eigen.js", "two_views.js", "models.js", "models_figures.js")),
    Page(
        "bundle",
        (*HOUSE, *SQUARES, "two_views.js", "bundle_adjustment.js", "bundle.js", "bundle_figures.js"),
    ),
    Page(
        "pipeline",
        (
            *SPACE,
            *SQUARES,
            "rays.js",
            "two_views.js",
            "bundle_adjustment.js",
            "reconstruction.js",
            "pose_graph.js",
            "pipeline_figures.js",
        ),
    ),
    Page("failures", ("linear.js", "failures.js", "failures_figures.js"), is_recorded=True),
    Page("fields", (*SPACE, "eigen.js", "fields.js", "fields_figures.js"), is_recorded=True),
    Page("questions", ()),
    Page("terms", ()),
)
"""Pages in the order of the lesson."""


def lesson_pages() -> dict[str, str]:
    """Every page in every language, by file name: `index.html`, `01_disparity.html`, `01_disparity.zh.html` and so on."""
    made = {}
    for language in LANGUAGES:
        made[_file("index", language)] = _rendered(Page("index", ()), language, 0)
        for number, page in enumerate(PAGES, 1):
            made[_file(_numbered(page, number), language)] = _rendered(page, language, number)
    return made


def _rendered(page: Page, language: str, number: int) -> str:
    words = _in(language, texts("lesson")) | _in(language, texts(page.name))
    script = "".join(own_asset(name) for name in ("widget.js", *page.scripts)) if page.scripts else ""
    all_pages = [
        {
            "number": k,
            "name": other.name,
            "file": _file(_numbered(other, k), language),
            "title": _in(language, texts(other.name))["title"],
            "about": _in(language, texts(other.name))["about"],
        }
        for k, other in enumerate(PAGES, 1)
    ]
    name = _numbered(page, number) if number else "index"
    names = {item["id"]: item["term"] for group in texts("terms")["groups"] for item in group["terms"]}
    return render(
        PACKAGE,
        f"{page.name}.html.jinja",
        title=words["title"],
        t=_marked(words),
        words=words.get("script", {}),
        scene=recorded(page.name) if page.is_recorded else scene_of(page.name),
        language=language,
        languages={code: (label, _file(name, code)) for code, label in LANGUAGES.items()},
        number=number,
        pages=all_pages,
        tools=_marked(_in(language, texts("terms")["tools"])),
        terms={id: _in(language, names[id]) for id in words.get("terms", ())},
        index=_file("index", language),
        stop=STOP[language],
        colon=COLON[language],
        style=Markup(asset("page.css") + own_asset("lesson.css")),
        script=Markup(script),
    )


def _numbered(page: Page, number: int) -> str:
    return f"{number:02d}_{page.name}"


def _file(name: str, language: str) -> str:
    return f"{name}.html" if language == "en" else f"{name}.{language}.html"


def _in(language: str, value: Any) -> Any:
    """Select the texts of one language: replaces every {en: ..., zh: ...}."""
    if isinstance(value, dict):
        if set(value) == set(LANGUAGES):
            return value[language]
        return {key: _in(language, part) for key, part in value.items()}
    return [_in(language, part) for part in value] if isinstance(value, list) else value


def _marked(value: Any) -> Any:
    """Mark texts as HTML, with their formulas: they come from our own files, and their tags are intended."""
    if isinstance(value, dict):
        return {key: _marked(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_marked(part) for part in value]
    return Markup(with_formulas(value)) if isinstance(value, str) else value


@cache
def texts(name: str) -> dict[str, Any]:
    """The texts of a page in both languages."""
    text = resources.files(PACKAGE).joinpath("texts", f"{name}.yaml").read_text(encoding="utf-8")
    return dict(yaml.safe_load(text))


@cache
def own_asset(name: str) -> str:
    """The text of a file in the lesson's `assets/`."""
    return resources.files(PACKAGE).joinpath("assets", name).read_text(encoding="utf-8")


def recorded(name: str) -> Any:
    """The recorded run that a page replays, from `assets/NAME.json`."""
    return json.loads(own_asset(f"{name}.json"))
