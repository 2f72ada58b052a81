"""Files of strangers are read in a process of their own, with limits: whatever a library does with one, a command ends
with one line.

A reader is a function of this package that takes plain arguments and answers with plain data (numbers, text, lists,
arrays, dataclasses of them, a compiled `mujoco.MjModel`)::

    recording = guard.call(_read, path, remap, what=f"recording {path}", size=path.stat().st_size)

What cannot leave a process (a `mujoco.MjSpec`, tensors on a device) is rehearsed there and then read here, where it
takes the same time and memory again. The reader's own UserError comes through as it is; any other error, a signal (a
fault in the library), and a limit passed are a UserError that begins with `what`.

The process is a fork, which costs some 10 ms and needs no imports: the readers touch no GPU, and torch works on one
thread there, since a fork has none of its threads. Where there is no safe fork it is spawned, once a call.
"""

from __future__ import annotations

import faulthandler
import gc
import multiprocessing
import os
import pickle
import re
import signal
import stat
import sys
import threading
import time
from collections.abc import Callable, Generator
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, TypeVar

from dexsim import system, typed
from dexsim.errors import UserError

T = TypeVar("T")
SECONDS, BYTES = 4.0, 1 << 30
"""Processor time and memory of a call."""
SECONDS_A_MIB, TIMES_SIZE = 3.0, 16
"""What is added for a file's size: s a MiB, and bytes a byte."""
TURN = 0.2
"""s after which a reader that says nothing is looked at."""
WAITING_S = 1.5
"""s without any processor time, asleep, after which a reader is taken to wait for a pipe or a device."""
LOCKED = "waits without end for another thread of its reader"
WAITS = "names a pipe, a device or a socket, which is no file: reading it waits without end"
FULL = re.compile("(could not|unable to|cannot|failed to) allocate|out of memory|bad_alloc|unknown exception", re.I)
"""What libraries say where they are given no more memory; the last is MuJoCo."""
TRUSTED = "DEXSIM_LIMITS"
"""Environment variable: a number that all limits are multiplied with."""
PACKAGE = Path(__file__).parent
inside = False
"""Whether this process works within a reader's limits already."""


def ours(path: Path) -> bool:
    """Return whether a file comes with dexsim."""
    return Path(os.path.abspath(path)).is_relative_to(PACKAGE)


def call(
    function: Callable[..., T], *args: Any, what: str, size: int = 0, patience: float = 1.0, wanted: bool = True
) -> T:
    """Return `function(*args)`, worked out in a process with limits. what: the file and its kind, for messages; size:
    bytes of the file, with which the limits grow; patience: multiplies the processor time, where more than reading is
    done; wanted: false leaves the answer there (None). Raises UserError."""
    work = turns(function, *args, what=what, size=size, patience=patience, wanted=wanted)
    try:
        while True:
            wait([next(work)], TURN)
    except StopIteration as end:
        return end.value


def turns(
    function: Callable[..., T], *args: Any, what: str, size: int = 0, patience: float = 1.0, wanted: bool = True
) -> Generator[Any, None, T]:
    """Work out what `call` does, turn by turn, so that a thread may wait for several at a time: yields what the next
    turn, at most `TURN` later, waits for; closed, it ends its process."""
    if inside:
        return function(*args)
    times = typed.number(TRUSTED, os.environ.get(TRUSTED, "1"), 1.0, 1e6)
    seconds = times * (patience * SECONDS + SECONDS_A_MIB * size / 2**20)
    most = int(times * (BYTES + TIMES_SIZE * size))
    answer: Any = ""
    for method in dict.fromkeys((system.start_method(), "spawn")):
        context: Any = multiprocessing.get_context(method)
        receive, send = context.Pipe(False)
        child = context.Process(target=_child, args=(send, os.getcwd(), function, args, seconds, most, wanted))
        try:
            try:
                child.start()
            except (pickle.PicklingError, AttributeError, TypeError):  # a new process cannot be given this reader
                break
            send.close()
            answer = yield from _answer(receive, child.pid or 0, 10 * seconds)
            child.join(1.0)  # it has nothing left to do; its sentinel tells a moment before it can be waited for
        finally:
            receive.close()
            if child.pid is not None:
                if child.is_alive():
                    child.kill()
                child.join()
        if answer != LOCKED:  # a fork may wait for a lock that a thread of this process held; a new process does not
            break
        answer = WAITS if method == "spawn" else LOCKED
    if isinstance(answer, tuple):
        return answer[0]
    if isinstance(answer, BaseException):
        raise answer
    more = f"; if you trust the file, {TRUSTED}={times * 10:g} in the environment allows ten times as much"
    ended = -(child.exitcode or 0)
    if answer:
        raise UserError(f"{what}: {answer}{more if 'memory' in answer else ''}")
    if ended in system.OUT_OF_TIME:
        raise UserError(f"{what}: takes more than {seconds:.0f} s of processor time to read{more}")
    how = signal.Signals(ended).name if ended > 0 else f"exit status {child.exitcode}"
    raise UserError(f"{what}: breaks the library that reads it ({how}, with at most {most / 2**30:.3g} GiB of memory)")


def _answer(receive: Connection, pid: int, wall: float) -> Generator[Any, None, Any]:
    """Return, after some turns, the child's answer in a tuple, its error, what it waits for in words, or "" where it
    ended without."""
    begun = moved = time.monotonic()
    used = -1
    while not receive.poll():
        now = time.monotonic()
        asleep, spent = system.at_work(pid)
        if spent != used or not asleep:
            used, moved = spent, now
        if now - moved > WAITING_S:
            return LOCKED if threading.active_count() > 1 else WAITS
        if now - begun > wall:
            return f"takes more than {wall:.0f} s to read"
        yield receive
    try:
        arrays = [bytearray(size) for size in pickle.loads(receive.recv_bytes())]
        answer = receive.recv_bytes()
        for part in arrays:
            receive.recv_bytes_into(part)
        return pickle.loads(answer, buffers=arrays)
    except EOFError:
        return ""
    except ValueError:  # MuJoCo writes a model cut off where it is given no more memory
        return "needs more memory to read than it may have"


def _child(
    send: Connection, here: str, function: Callable[..., Any], args: tuple, seconds: float, most: int, wanted: bool
) -> None:
    """Work out the answer in the process, send it, and end."""
    global inside
    inside = True
    os.chdir(here)  # a process that is begun anew has that of the program's start
    gc.freeze()  # what a fork would collect of the program may wait for a thread that is not here
    system.limit(seconds, most)
    faulthandler.disable()
    silent = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(silent, stream)
    for number in signal.valid_signals():
        if callable(signal.getsignal(number)):  # the program's own
            signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the program ends its child itself
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)  # the threads of before the fork are not there
    sys.addaudithook(_opened)
    answer: Any
    arrays: list[pickle.PickleBuffer] = []  # sent as they lie: a copy of all would be half of the memory
    try:
        answer = pickle.dumps((function(*args) if wanted else function(*args) and None,), 5,
                              buffer_callback=arrays.append)  # fmt: skip
    except BaseException as error:  # a reader of a stranger's file raises whatever it likes
        text = " ".join(str(error).split())[:200]
        full = isinstance(error, MemoryError) or FULL.search(text) is not None
        answer = pickle.dumps(
            error if isinstance(error, UserError) and not full
            else f"needs more than {most / 2**30:.3g} GiB of memory to read" if full
            else "is nested too deeply to be read" if isinstance(error, RecursionError)
            else f"cannot be read ({type(error).__name__}{': ' * bool(text)}{text})"
        )  # fmt: skip
        arrays.clear()
    parts = [array.raw() for array in arrays]
    for part in (pickle.dumps([part.nbytes for part in parts]), answer, *parts):
        send.send_bytes(part)
    os._exit(0)


def _opened(event: str, about: tuple) -> None:
    """Refuse what is no regular file, where Python's readers open one."""
    if event != "open" or not isinstance(about[0], (str, bytes)):
        return
    try:
        mode = os.stat(about[0]).st_mode
    except (OSError, ValueError):
        return  # who opens it says so
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode) and about[0] not in (os.devnull, "/dev/urandom"):
        raise UserError(f"{os.fsdecode(about[0])} is a device, a pipe or a socket, not a file")
