"""The loop in one process: input -> teleop -> control -> plant. Only this package imports all four."""
