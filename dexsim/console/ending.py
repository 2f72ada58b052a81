"""How a command ends: 0, 2 with one line for what a user can mend, 130 after Ctrl-C; a traceback only for our bugs."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import sys
import time
import warnings
from collections.abc import Callable

from dexsim.console import folders
from dexsim.errors import UserError

FULL = (errno.ENOSPC, errno.EDQUOT)
PLACES = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENAMETOOLONG, errno.ENOTDIR, errno.EISDIR, errno.ELOOP)
"""Of paths that cannot be used, whoever named them."""
FIRST_SPEAKS_S = 30.0
"""s that a rank gives the first of its machine to say what both find wrong."""


def guard(main: Callable[[list[str]], int], argv: list[str], about: str | None = None) -> int:
    """Run ``main(argv)`` and turn its errors into a line on stderr and an exit status.

    about: what ``-h`` or ``--help`` print instead of running, for a command that has no help of its own."""
    for stream in (sys.stdout, sys.stderr):  # halves of characters are printed as \\ud800, in any locale
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    if not sys.warnoptions:
        warnings.simplefilter("ignore")  # libraries', to their programmers
    try:
        if about and {"-h", "--help"} & set(argv):
            print(about.strip(), flush=True)
            return 0
        os.getcwd()
        folders.caches()
        status = main(argv)
        sys.stdout.flush()  # here, where a full device is a line
        return status
    except UserError as error:
        if _silent():
            # torchrun ends all ranks as soon as one has ended: the first, too, before it has said anything
            time.sleep(FIRST_SPEAKS_S)
        return _say(error, 2)  # also of a rank that nobody has ended by now: the first has not found it
    except KeyboardInterrupt:
        return 130 if _silent() else _say("stopped by Ctrl-C before there was anything to save", 130, "")
    except BrokenPipeError:  # e.g. `dexsim train --help | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (RuntimeError, MemoryError) as error:
        if "home directory" in str(error):  # pathlib's, of ~NAME/...
            return _say("a path begins with ~NAME, and this machine has no such user; write the whole path", 2)
        if not out_of_memory(error):
            raise
        return _say(
            f"the memory of the device is full ({' '.join(str(error).split())[:120]}); use fewer worlds=, or more"
            " agent.algorithm.num_mini_batches= where only learning does not fit",
            2,
        )
    except OSError as error:
        if error.errno == errno.ENOENT and not error.filename:
            if "temporary" in str(error):
                return _say("no folder for temporary files can be written: say one with TMPDIR=FOLDER", 2)
            with contextlib.suppress(OSError):
                os.getcwd()
                raise
            return _say("the folder that you are in is gone: go to one that is there (cd)", 2)
        if error.errno in PLACES and error.filename:
            return _say(f"{str(error.filename)[:200]}: {error.strerror}; give another path, or its rights", 2)
        if error.errno not in FULL:
            raise
        where = f" at {error.filename}" if error.filename else ", or what the output goes to"
        return _say(f"the disk is full{where}; free some space (training goes on with resume=<run folder>/last.pt)", 2)


def _silent() -> bool:
    """Return whether another process says it: under torchrun every rank of a machine finds the same wrong setting,
    the first speaks, and torchrun ends the others. What goes wrong later reaches rank 0 (dexsim.learning.lifeline)."""
    return os.environ.get("WORLD_SIZE", "1") != "1" and os.environ.get("LOCAL_RANK", "0") != "0"


def out_of_memory(error: BaseException) -> bool:
    """Return whether an error of torch, Warp or Python says that memory is full."""
    text = str(error).lower()
    return isinstance(error, MemoryError) or "out of memory" in text or "failed to allocate" in text


def _say(message: object, status: int, prefix: str = "error: ") -> int:
    try:
        sys.stdout.flush()
    except OSError:  # it would be tried again at the end of Python, with a traceback
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    print(f"\n{prefix}{message}" if status == 130 else f"{prefix}{message}", file=sys.stderr, flush=True)
    return status
