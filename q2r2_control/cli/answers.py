"""Ask the questions of a command. Answers are stored until the command succeeds, and the next try offers them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar, cast

import typer

Answer = TypeVar("Answer", float, str)


class RememberedAnswers:
    """Asks questions at a terminal, and stores in ``file`` the answers that differ from the proposed answers.

    ``about`` is the subject of the questions, such as the models. Stored answers about another subject are not offered.
    With ``yes``, each proposed answer is taken: nothing is asked, and no answer is stored.
    """

    def __init__(self, file: Path, about: Mapping[str, str], yes: bool = False) -> None:
        self.file, self._about, self._yes = file, dict(about), yes
        self._answers: dict[str, float | str] = {}
        if not yes:
            with suppress(OSError, ValueError, TypeError, KeyError):  # The file may be missing or damaged.
                kept = json.loads(file.read_text(encoding="utf-8"))
                if kept["about"] == self._about:
                    self._answers = dict(kept["answers"])

    @property
    def any(self) -> bool:
        """True if there are answers of an earlier try."""
        return bool(self._answers)

    def ask(self, question: str, usual: Answer) -> Answer:
        """Ask a question, and return the answer.

        If the user presses only Enter, the answer of the earlier try is taken, or ``usual`` if there was no earlier
        try.
        """
        if self._yes:
            return usual
        earlier = self._answers.get(question)
        kind = str if isinstance(usual, str) else float
        offered = earlier if isinstance(earlier, kind) else usual
        answer: Any = typer.prompt(question, default=offered, type=kind)
        self._answers.pop(question, None)
        if answer != usual:  # The next try proposes ``usual`` again, so it need not be stored.
            self._answers[question] = answer
        self._keep()
        return cast(Answer, answer)

    def drop(self, question: str) -> None:
        """Remove the stored answer to a question, because the command refused the answer."""
        if self._answers.pop(question, None) is not None:
            self._keep()

    def forget(self) -> None:
        """Remove the file, because the command succeeded. With ``yes``, the file stays, because it was not used."""
        if not self._yes:
            with suppress(OSError):
                self.file.unlink(missing_ok=True)

    def _keep(self) -> None:
        if not self._answers:
            self.forget()
            return
        with suppress(OSError):  # If the file cannot be written, the answers are still valid for this try.
            kept = {"about": self._about, "answers": self._answers}
            self.file.write_text(json.dumps(kept, indent=4, ensure_ascii=False), encoding="utf-8")
