"""Kill a parent process and see that its child ends too."""

import subprocess
import sys
import time


def ends_with_its_parent(code: str) -> bool:
    """Tell whether the child ends whose pid `code` prints first, when what runs it is killed."""
    parent = subprocess.Popen([sys.executable, '-c', code], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    parent.stdout.close()
    deadline = time.monotonic() + 20.0
    while _runs(child) and time.monotonic() < deadline:
        time.sleep(0.05)
    return not _runs(child)


def _runs(pid: int) -> bool:
    try:
        with open(f'/proc/{pid}/stat') as file:
            return file.read().rsplit(')', 1)[1].split()[0] != 'Z'
    except FileNotFoundError:
        return False
