"""Save a map over another one and be killed at the k-th step on the disk, for every k.

Run by test_map_store.py in a process of its own: it forks. Prints one line for each k.
"""

import os
import signal
import sys
from pathlib import Path

from saved_maps import made_up_map, same_map  # beside this file

from lcd_loop_closure.map_store import load_map, save_map

STEPS = ('fsync', 'rename', 'rmdir', 'unlink', 'mkdir')


def _die_at(step: int) -> None:
    """Count the calls that change the disk; die before the `step`-th."""
    left = step

    def counted(call):
        def replacement(*args, **kwargs):
            nonlocal left
            left -= 1
            if left <= 0:
                os.kill(os.getpid(), signal.SIGKILL)
            return call(*args, **kwargs)

        return replacement

    for name in STEPS:
        setattr(os, name, counted(getattr(os, name)))


def main() -> None:
    """Do it in the folder given on the command line."""
    folder = Path(sys.argv[1])
    old, new = made_up_map(seed=1), made_up_map(seed=2)
    step, finished = 0, False
    while not finished:
        step += 1
        target = folder / f'map{step}'
        save_map(old, target)
        child = os.fork()
        if child == 0:
            _die_at(step)
            save_map(new, target)
            os._exit(0)
        status = os.waitpid(child, 0)[1]
        finished = os.WIFEXITED(status)
        loaded = load_map(target)
        found = 'old' if same_map(loaded, old) else 'new' if same_map(loaded, new) else 'broken'
        save_map(new, target)  # what a kill left behind is in nobody's way
        if not same_map(load_map(target), new):
            found = 'broken afterwards'
        left = sorted(p.name for p in folder.iterdir() if p.name.startswith(f'.map{step}.'))
        words = [str(step), found, 'finished' if finished else 'killed', *left]
        sys.stdout.write(' '.join(words) + '\n')


if __name__ == '__main__':
    main()
