"""Recordings as datasets that policies are trained on."""
