"""Public controllers to compare with, each in a module of its own, which alone imports its package."""
