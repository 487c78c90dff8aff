"""Public controllers for comparison. Each is in a module of its own, and only that module imports its package."""
