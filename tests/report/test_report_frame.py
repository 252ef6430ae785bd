"""The frame of the pages: templates that escape, assets of the package, and no pipeline."""

import ast
import re
import tomllib
from collections.abc import Callable
from importlib import invalidate_caches, resources
from itertools import count
from pathlib import Path

import jinja2
import pytest
from markupsafe import Markup
from report_ring import HOSTILE

import epipole.report
from epipole.report import frame

FOLDER = Path(epipole.report.__file__).parent
ROOT = FOLDER.parent
PIPELINES = ("sfm.page", "stereo", "calibration", "fields", "slam.output")
NUMBERS = count()


@pytest.fixture
def render(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """The page of a package whose template holds the given text."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def render_text(text: str, title: str = "t", **values: object) -> str:
        folder = tmp_path / f"made_up_page_{next(NUMBERS)}"
        (folder / "templates").mkdir(parents=True)
        (folder / "__init__.py").write_text("")
        page = '{% extends "frame/base.html.jinja" %}{% block content %}' + text + "{% endblock %}"
        (folder / "templates" / "page.html.jinja").write_text(page)
        invalidate_caches()
        return frame.render(folder.name, "page.html.jinja", title=title, **values)

    return render_text


def body_of(page: str) -> str:
    return re.search(r"<main>\n?(.*?)<footer>", page, re.DOTALL).group(1)


@pytest.mark.parametrize(
    "template",
    [
        "{{ x }}",
        "{{ [x, x] | join }}",
        '{{ "<i>" ~ x }}',
        "{% set y %}{{ x }}{% endset %}{{ y }}",
        "{% macro m(v) %}{{ v }}{% endmacro %}{{ m(x) }}",
        "{% for c in [x] %}{{ c }}{% endfor %}",
        "{% autoescape false %}{{ x }}{% endautoescape %}",
        "{{ x | upper }}",
        '{{ "%s" | format(x) }}',
    ],
)
def test_no_value_of_a_template_skips_escaping(render: Callable[..., str], template: str) -> None:
    value = "<script>\x00\x1b\udcff\"'&"
    body = body_of(render(template, x=value))
    assert not set("<\x00\x1b\udcff\"'") & set(body)
    assert "&lt;" in body and "\ufffd\ufffd\ufffd" in body


def test_attributes_stay_attributes(render: Callable[..., str]) -> None:
    body = body_of(render('<p title="{{ x }}">a</p>', x='" onclick="alert(1)'))
    assert re.fullmatch(r'<p title="[^"<>]*">a</p>\n?', body)


def test_marked_pieces_stay_markup_but_for_what_no_page_may_hold(render: Callable[..., str]) -> None:
    page = render("{{ x }}", x=Markup("<b>\x01\ud800</b>"))
    assert body_of(page).strip() == "<b>\ufffd\ufffd</b>"
    page.encode("utf-8")


def test_the_title_is_escaped(render: Callable[..., str]) -> None:
    page = render("", title=HOSTILE)
    assert "<script>" not in page and "<1>" not in page
    assert "&lt;script&gt;alert" in page


def test_a_value_that_is_missing_is_an_error(render: Callable[..., str]) -> None:
    with pytest.raises(jinja2.UndefinedError, match="forgotten"):
        render("{{ forgotten }}")


def test_a_page_without_scripts_runs_none(render: Callable[..., str]) -> None:
    page = render("")
    assert "<script" not in page and "script-src" not in page and "default-src" in page


def test_templates_and_assets_are_files_of_the_package() -> None:
    files = resources.files("epipole.report")
    assert {p.name for p in files.joinpath("assets").iterdir()} == {
        *("page.js", "match_matrix.js", "orbit.js", "space.js", "end.js", "page.css", "figures.css"),
        *("webgl.js", "gaussian_drawing.js", "space_drawing.js", "space_picking.js", "space_tools.js"),
        *("space_layers.js", "space_mesh.js", "space_scale.js", "live.js"),
        "whole_space.css",
    }
    names = {p.name for p in files.joinpath("templates").iterdir()}
    assert "base.html.jinja" in names and all(name.endswith(".html.jinja") for name in names)
    for pipeline in PIPELINES:
        (template,) = resources.files(f"epipole.pipelines.{pipeline}").joinpath("templates").iterdir()
        assert template.read_text(encoding="utf-8").startswith('{% extends "frame/base.html.jinja" %}')


def test_every_file_that_is_no_module_goes_into_the_distribution() -> None:
    settings = tomllib.loads((ROOT.parents[1] / "pyproject.toml").read_text(encoding="utf-8"))
    patterns = settings["tool"]["setuptools"]["package-data"]["*"]
    files = [p for p in ROOT.rglob("*") if p.is_file() and p.suffix not in (".py", ".pyc")]
    assert len(files) > 10
    for path in files:
        package = next(folder for folder in path.parents if (folder / "__init__.py").is_file())
        assert any(path.relative_to(package).match(pattern) for pattern in patterns), path


def test_assets_can_stand_inside_a_page() -> None:
    for file in resources.files("epipole.report").joinpath("assets").iterdir():
        text = frame.asset(file.name)
        assert text.isascii() and text.endswith("\n") and "\r" not in text
        assert not re.search(r"</(script|style)|<!--", text, re.IGNORECASE)
        assert not re.search(r"https?:|@import|url\(", text)


def test_every_template_of_the_package_is_correct() -> None:
    for package in ("epipole.report", *(f"epipole.pipelines.{p}" for p in PIPELINES)):
        environment = frame._environment(package)
        for name in environment.list_templates():
            environment.get_template(name)


def test_no_template_switches_escaping_off() -> None:
    templates = list(ROOT.rglob("*.jinja"))
    assert len(templates) >= 8
    for path in templates:
        assert not re.search(r"\|\s*safe\b|autoescape|Markup", path.read_text(encoding="utf-8")), path.name


def test_the_frame_knows_no_pipeline() -> None:
    known = set()
    for path in FOLDER.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom):
                known.add(node.module or "")
            elif isinstance(node, ast.Import):
                known |= {alias.name for alias in node.names}
    rooms = {name.split(".")[1] for name in known if name.startswith("epipole.")}
    assert rooms <= {"report", "scene", "robust", "image", "geometry", "errors", "_version"}
    for template in (FOLDER / "templates").iterdir():
        assert "extends" not in template.read_text(encoding="utf-8"), template.name


def test_markup_stands_in_templates() -> None:
    """In Python there is markup in the charts, and where data blocks are written."""
    pages = [*FOLDER.rglob("*.py"), *(ROOT / "pipelines").rglob("page*.py")]
    assert len(pages) > 10
    for path in pages:
        if path.name not in ("charts.py", "markup.py"):
            assert not re.search(r"</?[a-z]+[ >]", path.read_text(encoding="utf-8")), path.name
