"""Tests of the QP and its limits with every installed solver, without a robot. ``pytest tests/qp`` runs all of them."""
