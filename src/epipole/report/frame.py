"""The frame of every page: templates that escape all values, and the scripts and styles inlined in the page.

A pipeline's page is a template in its package's folder `templates/`. It extends `frame/base.html.jinja`, uses the
macros of the other templates under `frame/` for sections, tables and images, and names the assets it needs.
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
from epipole.report.markup import bytes_block, count, escape, json_block, number, plural, seconds, sentence

_PACKAGE = "epipole.report"
GENERATOR = 'name="generator" content="epipole"'
"""Marks the head of every page based on `frame/base.html.jinja`."""


def render(package: str, template: str, *, title: str, **values: object) -> str:
    """Render a self-contained HTML page that loads no other file, font or script.

    Args:
        package: the package whose folder `templates/` has the template.
        template: the template's file name; it extends `frame/base.html.jinja`.
        title: title of the page.
        values: variables of the template. All values are escaped except `Markup`.
    """
    return _environment(package).get_template(template).render(title=title, **values)


def render_piece(package: str, template: str, **values: object) -> Markup:
    """Render a part of a page, such as a drawing, from a template; arguments as in `render`."""
    return Markup(_environment(package).get_template(template).render(**values))


@cache
def _environment(package: str) -> Environment:
    """Templates of one package, and those of the frame under `frame/`.

    `escape` is the final filter of every value a template writes, so that none can bypass it.
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
    words = (count, plural, number, seconds, sentence)
    for function in (*words, json_block, bytes_block, joined_assets, content_hash):
        environment.globals[function.__name__] = function
    environment.globals["version"] = __version__
    environment.globals["generator"] = Markup(GENERATOR)
    return environment


@cache
def asset(name: str) -> str:
    """The text of a file in `assets/`."""
    return resources.files(_PACKAGE).joinpath("assets", name).read_text(encoding="utf-8")


def joined_assets(names: Sequence[str]) -> Markup:
    """Several assets concatenated into one script or style sheet."""
    return Markup("".join(asset(name) for name in names))


def content_hash(script: str) -> str:
    """The hash by which a page's Content-Security-Policy allows a script, and no other."""
    digest = hashlib.sha256(script.encode("utf-8")).digest()
    return f"sha256-{base64.b64encode(digest).decode('ascii')}"
