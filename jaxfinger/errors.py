"""What a user can mend is said in one sentence, without a traceback."""


class UserError(Exception):
    """A mistake in a file, a recipe or a command: the message names the place and the mend."""
