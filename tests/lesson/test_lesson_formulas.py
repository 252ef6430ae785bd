"""The notation of formulas becomes MathML; every formula of the texts is well-formed."""

import xml.etree.ElementTree as ElementTree

import pytest

from epipole.lesson.formulas import FORMULA, mathml
from epipole.lesson.pages import LANGUAGES, PAGES, texts


def leaves(element):
    return "".join(element.itertext())


def test_symbols_scripts_and_fractions():
    fraction = ElementTree.fromstring(mathml("d = @1{x_L} - {f B}/{Z}"))
    assert leaves(fraction) == "d=xL−fBZ"
    assert [leaves(part) for part in fraction.find(".//mfrac")] == ["fB", "Z"]
    assert [leaves(part) for part in fraction.find(".//mrow[@class='s1']//msub")] == ["x", "L"]
    prime = ElementTree.fromstring(mathml("K'^{-T}"))
    assert [leaves(part) for part in prime.find(".//msup")] == ["K′", "−T"]
    assert ElementTree.fromstring(mathml("a / b")).find(".//mfrac") is None


def test_a_matrix_has_rows_and_columns():
    table = ElementTree.fromstring(mathml('[t]_× = mat{0, -t_z; t_z, 0} "for" t')).find(".//mtable")
    assert [[leaves(cell) for cell in row] for row in table] == [["0", "−tz"], ["tz", "0"]]


@pytest.mark.parametrize("notation", ["{a", "a_", "hat", "mat{a, b", "@1", "x^"])
def test_what_is_not_closed_is_refused(notation):
    with pytest.raises(ValueError, match=r"^A formula "):
        mathml(notation)


def formulas(value):
    if isinstance(value, str):
        yield from FORMULA.findall(value)
    elif isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from formulas(part)


def both(value):
    """Texts that are there in each language."""
    if isinstance(value, dict) and set(value) == set(LANGUAGES):
        yield value
    elif isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from both(part)


@pytest.mark.parametrize("name", [page.name for page in PAGES])
def test_formulas_are_well_formed_and_the_same_in_both_languages(name):
    for notation in formulas(texts(name)):
        ElementTree.fromstring(mathml(notation))
    for text in both(texts(name)):
        en, zh = ({*formulas(text[language])} for language in LANGUAGES)
        assert en == zh
        assert text["en"].count("$") % 2 == 0
