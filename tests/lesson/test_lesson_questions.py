"""The questions: each answer opens on a click and leads to a page and to a function that there are."""

import importlib

import pytest

from epipole.lesson.pages import PAGES, texts

QUESTIONS = texts("questions")["questions"]


@pytest.mark.parametrize("question", QUESTIONS, ids=lambda question: question["function"])
def test_a_function_is_there_by_its_name(question):
    module, _, name = question["function"].rpartition(".")
    assert callable(getattr(importlib.import_module(module), name))


def test_every_page_is_asked_about():
    assert {question["page"] for question in QUESTIONS} == {page.name for page in PAGES} - {
        "questions",
        "terms",
    }


def test_answers_open_on_a_click_and_lead_on(tab):
    tab.open("12_questions.html")
    answers = tab.page.locator("details")
    assert answers.count() == len(QUESTIONS)
    for k, question in enumerate(QUESTIONS):
        answer = answers.nth(k)
        assert not answer.locator("p").first.is_visible()
        answer.locator("summary").click()
        assert answer.locator("p").first.is_visible()
        assert question["function"] in answer.inner_text()
        assert question["page"] in answer.locator("a").get_attribute("href")
