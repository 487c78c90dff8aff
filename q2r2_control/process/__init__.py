"""The process that runs a loop."""
