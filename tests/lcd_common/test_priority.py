"""All threads stand back, also those that ran before and those that come."""

import subprocess
import sys

_CODE = """
import os, threading
from lcd_common.priority import lower_priority

def niceness():
    return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

def work():
    asked.wait()
    found.append(niceness())

found, asked, begun = [], threading.Event(), niceness()
before = threading.Thread(target=work)
before.start()
lower_priority(3)
asked.set()
after = threading.Thread(target=work)
after.start()
before.join()
after.join()
print([n - begun for n in (niceness(), *found)])
lower_priority(19)
print(niceness())
"""


def test_every_thread_stands_back() -> None:
    run = subprocess.run(
        [sys.executable, '-c', _CODE], capture_output=True, text=True, check=True, timeout=60
    )
    assert run.stdout.splitlines() == ['[3, 3, 3]', '19']
