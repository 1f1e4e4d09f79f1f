"""What an error tells its reader."""


def told(error: BaseException) -> str:
    """The message and its notes, which Python 3.10 has within the message."""
    return "\n".join([str(error), *getattr(error, "__notes__", [])])
