"""Checks of the controller's promises at every tick, under hostile input and injected faults."""
