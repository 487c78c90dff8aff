"""What people see of a run: a live table, a summary, a report of plots. All of it listens; nothing waits for it."""
