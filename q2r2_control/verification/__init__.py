"""Whether the controller keeps its promises: checked at every tick, under hostile input and injected faults."""
