"""Watch a set of nodes from outside, for ``q2r2 ros watch`` and ``doctor``."""
