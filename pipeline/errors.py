"""Errors in the user's files and arguments, and remedies for errors of the operating system."""

import errno
import sqlite3

_ROOM, _PERMISSION = "Make room there, or set another output folder.", "Give permission, or set another folder."
_ADVICE = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), _ROOM),
    **dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), _PERMISSION),
    **dict.fromkeys((errno.EMFILE, errno.ENFILE), "Close other programs, or allow more open files (ulimit -n)."),
    errno.ENAMETOOLONG: "Choose a shorter name.",
    errno.ENOMEM: "Close other programs: the memory is full.",
}
_OF_DATABASE = {
    **dict.fromkeys((sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR), f"{_ROOM} What was measured is kept."),
    **dict.fromkeys((sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_PERM), _PERMISSION),
    sqlite3.SQLITE_BUSY: "Another process has it: let that end first.",
}


class InputError(Exception):
    """Error in a file or an argument; the message states what is wrong, where, and the remedy."""


class WriteError(InputError):
    """A file cannot be written; its earlier content is unchanged."""


def missing_extra(user: str, packages: str, extra: str) -> InputError:
    """Error for a command or option whose packages are not installed."""
    return InputError(
        f"{user} needs {packages}, which this installation lacks. Install: pip install 'reseau[{extra}]'."
    )


def what_to_do(error: OSError) -> str:
    """Remedy for an error of the operating system."""
    return _ADVICE.get(error.errno or 0, "Check the path, and that the drive is there.")


def what_to_do_about_database(error: BaseException) -> str:
    """Remedy for an operating-system error within SQLite; "" for other errors."""
    return _OF_DATABASE.get(getattr(error, "sqlite_errorcode", 0) & 0xFF, "")
