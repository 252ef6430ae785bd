"""The frame of every page: templates that escape all values, and the scripts and styles inside the page.

A pipeline's page is a template in the folder `templates/` of its own package. It extends
`frame/base.html.jinja`, takes sections, tables and images from the other templates under `frame/`, and names
the assets it needs.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from functools import cache
from importlib import resources

from jinja2 import ChoiceLoader, Environment, PackageLoader, PrefixLoader, StrictUndefined
from markupsafe import Markup

from epipole._version import __version__
from epipole.report.markup import bytes_block, count, escape, json_block, number, plural, seconds

_PACKAGE = "epipole.report"
GENERATOR = 'name="generator" content="epipole"'
"""Stands in the head of every page that is made from `frame/base.html.jinja`."""


def render(package: str, template: str, *, title: str, **values: object) -> str:
    """One HTML page with everything inside it: no file, font or script from elsewhere.

    Args:
        package: whose folder `templates/` holds the template.
        template: its file; it extends `frame/base.html.jinja`.
        title: of the page.
        values: what the template shows, by name. Everything is escaped but `Markup`.
    """
    return _environment(package).get_template(template).render(title=title, **values)


def render_piece(package: str, template: str, **values: object) -> Markup:
    """A part of a page, a drawing for one, from a template of its own; arguments as of `render`."""
    return Markup(_environment(package).get_template(template).render(**values))


@cache
def _environment(package: str) -> Environment:
    """Templates of one package, and those of the frame under `frame/`.

    `escape` comes last for every value that a template writes, escaped by Jinja or not: none can skip it.
    """
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(package), PrefixLoader({"frame": PackageLoader(_PACKAGE)})]),
        autoescape=True,
        finalize=escape,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    words = (count, plural, number, seconds)
    for function in (*words, json_block, bytes_block, joined_assets, content_hash):
        environment.globals[function.__name__] = function
    environment.globals["version"] = __version__
    environment.globals["generator"] = Markup(GENERATOR)
    return environment


@cache
def asset(name: str) -> str:
    """The text of a file of `assets/`."""
    return resources.files(_PACKAGE).joinpath("assets", name).read_text(encoding="utf-8")


def joined_assets(names: Sequence[str]) -> Markup:
    """Several assets one after another, as one script or style sheet."""
    return Markup("".join(asset(name) for name in names))


def content_hash(script: str) -> str:
    """What a page's policy calls a script by, so that the browser runs this one and no other."""
    digest = hashlib.sha256(script.encode("utf-8")).digest()
    return f"sha256-{base64.b64encode(digest).decode('ascii')}"
