"""The one exception root: every error the package raises on purpose says what, where and what is allowed."""


class Q2R2Error(Exception):
    """Root of all errors that q2r2_control raises on purpose."""


class ConfigError(Q2R2Error):
    """A configuration cannot be used; the message names file, key, value and what is allowed."""


class RobotError(Q2R2Error):
    """A robot description cannot be loaded or does not have what the controller needs."""
