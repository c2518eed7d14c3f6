"""Check that every console script is installed, resolves and answers --help soon."""

import importlib
import os
import resource
import subprocess
import sys
from pathlib import Path

# Processor time, because the wall clock also counts what else the machine does.
HELP_SECONDS = 6.0


def test_no_two_packages_install_the_same_command(python_packages):
    names = [name for package in python_packages for name in package.console_scripts()]
    assert len(names) == len(set(names))


def test_every_command_resolves(package):
    for command, target in package.console_scripts().items():
        module, function = target.split(':')
        assert callable(getattr(importlib.import_module(module), function)), command


def test_every_command_is_installed_and_answers_help(package):
    for command in package.console_scripts():
        executable = Path(sys.executable).parent / command
        assert os.access(executable, os.X_OK), f'{executable} is missing: run make setup'
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = subprocess.run(
            [str(executable), '--help'],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
            stdin=subprocess.DEVNULL,
        )
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        assert done.returncode == 0, f'{command} --help: {done.stderr}'
        assert len(done.stdout.splitlines()) > 2, f'{command} --help says too little'
        spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        assert spent < HELP_SECONDS, f'{command} --help took {spent:.1f} s of processor time'
