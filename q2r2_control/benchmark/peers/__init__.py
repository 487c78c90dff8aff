"""Public controllers to compare with, each in a module of its own; nothing else imports their packages."""
