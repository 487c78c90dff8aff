"""Tests of the page of a run in a real browser. ``make test-web`` runs them."""
