"""The table of broken lines names lines that exist; whether something finds them takes an hour: run it by hand."""

from __future__ import annotations

from tests.support.modules import ROOT, load_script


def test_every_line_of_the_table_stands_once_in_its_file() -> None:
    for mutation in load_script("benchmarks/safety_mutations.py").MUTATIONS:
        text = (ROOT / mutation.path).read_text(encoding="utf-8")
        assert text.count(mutation.old) == 1, mutation.claim
