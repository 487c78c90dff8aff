"""A tick's record, and the figures of a whole run."""
