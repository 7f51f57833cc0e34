"""What the user's files and arguments can get wrong."""


class InputError(Exception):
    """A file or an argument is not as it should be: the message says what, where, what would be right, what to do."""
