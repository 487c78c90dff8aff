"""Converts recordings to datasets that policies are trained on."""
