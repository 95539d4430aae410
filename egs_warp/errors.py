"""The one error a user can cause."""


class UserError(ValueError):
    """Bad input. The message is one line: what is wrong, where, and what to do. The command exits with status 2."""
