"""Errors that a user's input can cause."""


class CaromError(ValueError):
    """Something about the input is wrong: the message names the argument, what it was, and what to do."""
