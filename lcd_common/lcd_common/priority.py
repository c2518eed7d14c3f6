"""Let a process stand back behind others."""

import os


def lower_priority(niceness: int) -> None:
    """Raise the niceness of all threads of this process, and of those that they will start.

    On Linux `os.nice` is a matter of the calling thread alone: threads that run already keep
    theirs, and they are the ones that work.

    Args:
        niceness: 0..19 above what each thread has.
    """
    for name in os.listdir('/proc/self/task'):
        thread = int(name)
        try:
            now = os.getpriority(os.PRIO_PROCESS, thread)
            os.setpriority(os.PRIO_PROCESS, thread, min(19, now + niceness))
        except ProcessLookupError:  # it ended meanwhile
            continue
