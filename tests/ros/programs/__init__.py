"""Programs that tests start as separate processes: ``python -m tests.ros.programs.<name>``."""
