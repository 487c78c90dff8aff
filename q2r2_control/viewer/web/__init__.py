"""The page of a run in a browser. Its server is a process of its own, which the loop never waits for."""
