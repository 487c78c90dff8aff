"""Answers to the questions of a command, kept until it ends well: the next try offers them instead of its guesses."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar, cast

import typer

Answer = TypeVar("Answer", float, str)


class RememberedAnswers:
    """Asks at a terminal, and keeps the answers that are not what was offered in a ``file``.

    ``about`` says what the questions are about. Answers about something else are not offered. With ``yes`` nothing is
    asked, offered or kept.
    """

    def __init__(self, file: Path, about: Mapping[str, str], yes: bool = False) -> None:
        self.file, self._about, self._yes = file, dict(about), yes
        self._answers: dict[str, float | str] = {}
        if not yes:
            with suppress(OSError, ValueError, TypeError, KeyError):  # a file that says nothing of use
                kept = json.loads(file.read_text(encoding="utf-8"))
                if kept["about"] == self._about:
                    self._answers = dict(kept["answers"])

    @property
    def any(self) -> bool:
        """True if there are answers of an earlier try."""
        return bool(self._answers)

    def ask(self, question: str, usual: Answer) -> Answer:
        """The answer to a question; the answer of the earlier try is offered, or else ``usual``."""
        if self._yes:
            return usual
        earlier = self._answers.get(question)
        kind = str if isinstance(usual, str) else float
        offered = earlier if isinstance(earlier, kind) else usual
        answer: Any = typer.prompt(question, default=offered, type=kind)
        self._answers.pop(question, None)
        if answer != usual:  # what was accepted as it was found is found anew
            self._answers[question] = answer
        self._keep()
        return cast(Answer, answer)

    def forget(self) -> None:
        """Remove the file, since the command ended well."""
        with suppress(OSError):
            self.file.unlink(missing_ok=True)

    def _keep(self) -> None:
        if not self._answers:
            self.forget()
            return
        with suppress(OSError):  # the answers count all the same
            kept = {"about": self._about, "answers": self._answers}
            self.file.write_text(json.dumps(kept, indent=4, ensure_ascii=False), encoding="utf-8")
