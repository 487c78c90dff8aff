"""After a command was interrupted or failed, a person's answers are offered again, but only for the same subject."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from q2r2_control.cli import answers
from q2r2_control.cli.answers import RememberedAnswers

ABOUT = {"left": "iiwa7"}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "answers.json"


def offered(monkeypatch: pytest.MonkeyPatch, *typed: Any) -> list[Any]:
    """Answer the next questions by ``typed``, where None accepts the default. Return a list of the offered defaults."""
    seen: list[Any] = []
    left = list(typed)

    def prompt(question: str, default: Any, type: Any) -> Any:
        seen.append(default)
        answer = left.pop(0)
        return default if answer is None else answer

    monkeypatch.setattr(answers.typer, "prompt", prompt)
    return seen


def test_the_next_try_offers_answers_that_were_typed_but_no_defaults_that_were_accepted(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = offered(monkeypatch, 0.4, None, None, None)
    first = RememberedAnswers(file, ABOUT)
    assert not first.any
    assert (first.ask("height", 0.1), first.ask("home", "0 1")) == (0.4, "0 1")
    again = RememberedAnswers(file, ABOUT)
    assert again.any
    assert again.ask("height", 0.2) == 0.4
    assert again.ask("home", "0 2") == "0 2", "a home that was found is found anew"
    assert seen == [0.1, "0 1", 0.4, "0 2"]
    again.forget()
    assert not file.exists()


@pytest.mark.parametrize("text", ["", "[]", "{", '{"about": {"left": "panda"}, "answers": {"height": 3.0}}'])
def test_answers_in_a_damaged_file_or_in_a_file_about_another_subject_are_not_offered(
    text: str, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file.write_text(text)
    seen = offered(monkeypatch, None)
    assert RememberedAnswers(file, ABOUT).ask("height", 0.1) == 0.1
    assert seen == [0.1]


def test_an_answer_whose_type_does_not_fit_its_question_is_not_offered(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file.write_text('{"about": {"left": "iiwa7"}, "answers": {"height": "high"}}')
    seen = offered(monkeypatch, None)
    assert RememberedAnswers(file, ABOUT).ask("height", 0.1) == 0.1
    assert seen == [0.1]


def test_the_option_yes_prevents_all_questions_and_does_not_change_the_kept_answers(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    offered(monkeypatch, 0.4)
    RememberedAnswers(file, ABOUT).ask("height", 0.1)
    seen = offered(monkeypatch)
    before = file.read_text()
    all_as_found = RememberedAnswers(file, ABOUT, yes=True)
    assert all_as_found.ask("height", 0.1) == 0.1
    all_as_found.forget()
    assert seen == []
    assert file.read_text() == before


def test_an_answer_that_was_refused_is_not_offered_again(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    offered(monkeypatch, 0.4, "north", None, None)
    first = RememberedAnswers(file, ABOUT)
    first.ask("height", 0.1)
    first.ask("home", "0 1")
    first.drop("home")
    first.drop("never asked")
    again = RememberedAnswers(file, ABOUT)
    assert (again.ask("height", 0.1), again.ask("home", "0 1")) == (0.4, "0 1")
