"""How a command can end."""

OK, UNTRUSTED, BAD_INPUT = 0, 1, 2
SIGINT, SIGPIPE = 130, 141  # as shells report a program that these signals end


class BadInput(Exception):
    """``BadInput`` is what the caller can put right; it ends the command with one line and exit code 2."""
