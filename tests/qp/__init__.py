"""Offline tests of the QP under limits with every solver that is installed: ``pytest tests/qp`` runs all of them."""
