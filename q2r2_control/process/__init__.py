"""Start, schedule and end processes: the one that runs a loop, and those beside it."""
