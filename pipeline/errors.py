"""What the user's files and arguments can get wrong, and what helps where the machine refuses."""

import errno

_ADVICE = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), "Make room there, or set another output folder."),
    **dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), "Give permission, or set another folder."),
    **dict.fromkeys((errno.EMFILE, errno.ENFILE), "Close other programs, or allow more open files (ulimit -n)."),
    errno.ENAMETOOLONG: "Choose a shorter name.",
    errno.ENOMEM: "Close other programs: the memory is full.",
}


class InputError(Exception):
    """A file or an argument is not as it should be: the message says what, where, what would be right, what to do."""


class WriteError(InputError):
    """A file cannot be written: what stood there is as it was."""


def what_to_do(error: OSError) -> str:
    """The next step after what the operating system refused."""
    return _ADVICE.get(error.errno or 0, "Check the path, and that the drive is there.")
