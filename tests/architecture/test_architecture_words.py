"""One vocabulary: names and texts of the source use the words of the field, not household words for them."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml
from architecture_sources import Source, sources

REPOSITORY = Path(__file__).parents[2]

NAMES = {
    **dict.fromkeys(("picture", "pictures"), "image"),
    **dict.fromkeys(
        ("place", "places", "placed", "placing"), "pose, position; registered, localized, triangulated"
    ),
    **dict.fromkeys(("told", "tells"), "given, measured"),
    **dict.fromkeys(("follow", "followed", "follows"), "track"),
    **dict.fromkeys(("turn", "turned", "turns", "turning"), "rotate, rotation"),
    **dict.fromkeys(("drawn", "draws", "unblend"), "render, sample; backward"),
    **dict.fromkeys(("likeness", "doubt", "doubts", "sketch"), "loss, similarity; warnings; fingerprint"),
    **dict.fromkeys(("begin", "begun", "begins"), "start, initialization"),
    **dict.fromkeys(("settle", "settled", "settles"), "optimize, converge"),
    **dict.fromkeys(("way", "ways"), "trajectory, direction"),
    **dict.fromkeys(("held", "hold", "holding"), "fixed, constrained"),
    **dict.fromkeys(("tie", "ties", "tied"), "constraint"),
    **dict.fromkeys(("forget", "forgets", "forgotten"), "cull, remove"),
    **dict.fromkeys(("lens", "lenses"), "camera, intrinsics"),
    **dict.fromkeys(("sure", "unsure", "heeded"), "certain, uncertain; graceful"),
    **dict.fromkeys(("shares", "shot", "shots", "halves", "pull"), "fractions; views; split; gradient"),
}
"""Parts of identifiers, and what stands in their place."""
ALLOWED_NAMES = {"held_out", "held_out_rms_px", "MOST_HELD_OUT", "fillna"}
"""`held_out`: the views that a training does not see."""

TEXTS = {
    r"\bpictures?\b": "image",
    r"(?<!in )(?<!take )(?<!takes )(?<!decimal )(?<!first )\bplace[sd]?\b": "pose, position; registered, localized, triangulated",
    r"\btold\b|\btells?\b": "given, specified, measures, determines",
    r"\bfollow(s|ed|ing)? (the |a |each |its )?(points?|cameras?|corners?|features?|frames?)\b|\bfollowed\b": "track",
    r"\bturned\b(?! (on|off|into|out))|\bturning\b|\bturns\b(?! (on|off|into|out))|\bturn of\b|\ba turn\b": "rotate, rotation",
    r"\blikeness\b": "PSNR, SSIM, similarity",
    r"\b(the|its|a|each|their) begin\b": "start, initialization",
    r"\bsettle[sd]?\b": "optimize, converge",
    r"\bunsure\b|\bsurely\b|\bhow sure\b": "uncertain, standard deviation",
    r"\b(the|a|this|its|their|largest|least|smallest) shares?\b|\b(Shares?|a share) of\b": "fraction, ratio",
    r"\binertial units?\b": "IMU",
    r"\bso many\b|\bas many as\b": "the number itself",
    r"\bthe eye\b": "the viewpoint",
    r"\blens(es)?\b(?! distortion)": "camera, intrinsics",
    r"\b(is|are|was|were|be|been) held\b(?! out)|\bholds? (fast|still)\b": "fixed, constrained",
    r"\bforg[eo]ts?\b|\bforgotten\b|\blet go\b": "cull, remove",
    r"\bties?\b|\btied\b": "constraint, connected",
    r"\bseen again\b|\bfound again\b": "revisited, relocalized, detected again",
    r"\bin the end\b|\bas it is\b|\bof its own\b": "usually nothing",
    r"\b(nothing|nobody|no one) (tells|gave|gives|knows|said|says)\b": "unknown, not given",
}
"""Phrases of docstrings, comments and messages, and what says it in the words of the field."""
DRAWING = r"\bdraw(s|n|ing)?\b"
CHARTS = ("report", "viewer", "lesson", "pipelines/viewing")
"""Folders in which charts are drawn; elsewhere an image is rendered, and a number sampled."""


BRITISH = {
    "colour": "color",
    "centre|centring": "center",
    "grey": "gray",
    "behaviour": "behavior",
    "neighbour": "neighbor",
    r"metres?(?![a-z])": "meter",
    "modelled|modelling|labelled(?!by)|labelling|travelled|travelling|cancelled|cancelling": "one l",
    "favour|honour": "or",
    r"catalogue(?![a-z])|licence|artefact|judgement": "catalog, license, artifact, judgment",
    "(?:normal|factor|summar|local|minim|maxim|optim|raster|initial|recogn|linear|regular|visual)is(?:e|ing|ation)": "z",
    r"(?<![a-z])(?:towards|learnt)(?![a-z])": "toward, learned",
}
"""British spellings in texts and names, in lower case, and the American ones."""
BRITISH_NAMES = r"'grey'|\"grey\"|grey=|grey must|\b[Cc]olour\"|'colour'"
"""Keys of files and names that remain: the map file of SLAM has a key `grey`."""


def british_in(text: str) -> Iterator[tuple[re.Match[str], str]]:
    text = re.sub(BRITISH_NAMES, lambda m: "_" * len(m.group()), text).lower()
    for spelling, better in BRITISH.items():
        for match in re.finditer(spelling, text):
            yield match, better


def test_spelling_of_the_source_is_american() -> None:
    wrong = [
        f"{source.name}:{source.text[: m.start()].count(chr(10)) + 1} {m.group()!r} -> {better}"
        for source in sources()
        for m, better in british_in(source.text)
    ]
    assert not wrong, "\n".join(wrong)


FOREIGN = ("io/calibration/model_names.py", "io/models/_transforms_keys.py")
"""Files with patterns of keys that other programs write, such as `lens_model`."""


def names_of(source: Source) -> Iterator[tuple[int, str]]:
    """Line and identifier of what a file defines, binds or takes."""
    for node in source.nodes:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.lineno, node.name
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.attr


def parts_of(name: str) -> set[str]:
    return {part.lower() for part in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)}


def texts_of(source: Source) -> Iterator[tuple[int, str]]:
    """Line and text of every string and comment; a single word is a key or a name of a file, which is no text."""
    for token in tokenize.generate_tokens(io.StringIO(source.text).readline):
        is_text = token.type == tokenize.STRING and not re.fullmatch(r"\w*([\"'])[\w./-]*\1", token.string)
        if is_text or token.type == tokenize.COMMENT:
            yield token.start[0], token.string


def test_names_are_of_the_field() -> None:
    wrong = []
    for source in sources():
        for line, name in names_of(source):
            if name not in ALLOWED_NAMES and (bad := parts_of(name) & NAMES.keys()):
                wrong += [f"{source.name}:{line} {name}: {word} -> {NAMES[word]}" for word in bad]
    assert not wrong, "\n".join(sorted(set(wrong)))


def test_texts_are_of_the_field() -> None:
    wrong = []
    for source in sources():
        phrases = TEXTS if source.name.startswith(CHARTS) else {**TEXTS, DRAWING: "render, sample"}
        if source.name in FOREIGN:
            phrases = {phrase: better for phrase, better in phrases.items() if "lens" not in phrase}
        for line, text in texts_of(source):
            for phrase, better in phrases.items():
                wrong += [
                    f"{source.name}:{line + text[: m.start()].count(chr(10))} {m.group()!r} -> {better}"
                    for m in re.finditer(phrase, text, re.IGNORECASE)
                ]
    assert not wrong, f"{len(wrong)} phrases\n" + "\n".join(sorted(set(wrong)))


PAGES = ("*.md", "docs/**/*.md", "docs/**/*.py", "benchmarks/**/*.py", "benchmarks/*.md", "examples/*.py")
"""Files of the repository that people read, besides the source and the lesson."""
CODE = r"```.*?```|`[^`\n]*`|\]\([^)]*\)|\{[^}\n]*\}"
"""In Markdown: blocks and spans of code, targets of links, attributes."""
KEYS = r"\[[\"']\w+[\"']\]|docs/pictures|dataset\.\w+"
"""In scripts: keys of results that were measured with an earlier version, a folder, and attributes of the viewer's page."""
PLAIN = {r"\bturns\b(?= (its|photographs|images|points|pixels|a|the)\b)": ""}
"""`turns photographs into models` is what the word means."""


@cache
def page_texts(path: Path) -> list[tuple[int, str]]:
    """Line and text of a page, or of the strings and comments of a script."""
    text = path.read_text()
    if path.suffix == ".py":
        return [(line, re.sub(KEYS, "", one)) for line, one in texts_of(Source(path, text, ast.parse(text)))]
    return [(1, re.sub(CODE, lambda m: "\n" * m.group().count("\n"), text, flags=re.DOTALL))]


def phrases_in(text: str) -> Iterator[tuple[re.Match[str], str]]:
    for phrase in PLAIN:
        text = re.sub(phrase, "makes", text)
    for phrase, better in TEXTS.items():
        for match in re.finditer(phrase, text, re.IGNORECASE):
            yield match, better


@pytest.mark.parametrize("pattern", PAGES)
def test_pages_are_of_the_field(pattern: str) -> None:
    paths = sorted(REPOSITORY.glob(pattern))
    assert paths
    wrong = [
        f"{path.relative_to(REPOSITORY)}:{line + text[: m.start()].count(chr(10))} {m.group()!r} -> {better}"
        for path in paths
        for line, text in page_texts(path)
        for m, better in phrases_in(text)
    ]
    assert not wrong, f"{len(wrong)} phrases\n" + "\n".join(wrong)


@pytest.mark.parametrize("pattern", PAGES)
def test_spelling_of_pages_is_american(pattern: str) -> None:
    wrong = [
        f"{path.relative_to(REPOSITORY)} {m.group()!r} -> {better}"
        for path in sorted(REPOSITORY.glob(pattern))
        for _, text in page_texts(path)
        for m, better in british_in(text)
    ]
    assert not wrong, "\n".join(wrong)


def english_of(value: Any, at: str) -> Iterator[tuple[str, str]]:
    """Key and English text of everything below a part of the lesson's texts."""
    if isinstance(value, dict) and set(value) == {"en", "zh"}:
        yield at, value["en"]
    elif isinstance(value, dict | list):
        for key, part in value.items() if isinstance(value, dict) else enumerate(value):
            yield from english_of(part, f"{at}.{key}")


def test_the_lesson_is_of_the_field() -> None:
    wrong = [
        f"{at} {m.group()!r} -> {better}"
        for path in sorted((REPOSITORY / "src" / "epipole" / "lesson" / "texts").glob("*.yaml"))
        for at, text in english_of(yaml.safe_load(path.read_text()), path.stem)
        for m, better in phrases_in(text)
    ]
    assert not wrong, "\n".join(wrong)


def test_the_check_finds_what_it_looks_for() -> None:
    """A file with a word of each kind does not pass."""
    code = '"""A picture whose place nothing tells."""\n\n\ndef draw_picture(lens, *, turn_deg):\n    place = 1  # settled\n'
    source = Source(sources()[0].path, code, ast.parse(code))
    found = [parts_of(name) & NAMES.keys() for _, name in names_of(source)]
    assert found == [{"picture"}, {"lens"}, {"turn"}, {"place"}]
    texts = " ".join(text for _, text in texts_of(source))
    assert sum(bool(re.search(phrase, texts)) for phrase in TEXTS) == 5
