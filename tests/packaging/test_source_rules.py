"""Check the rules every source file keeps."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

MAX_LINES = 400
CODE = {'.py', '.sh', '.cmake', '.msg', '.srv'}

# Import all modules named in argv with ROS blocked; print those that need it.
IMPORT_WITHOUT_ROS = """
import importlib, re, sys, traceback

class NoRos:
    def find_spec(self, name, path=None, target=None):
        top = name.partition('.')[0]
        if re.fullmatch(r'rclpy|rosidl_.*|tf2_ros|message_filters|.*_(msgs|srvs|interfaces)', top):
            raise ImportError(f'{name} is ROS')

sys.meta_path.insert(0, NoRos())
for name in sys.argv[1:]:
    try:
        importlib.import_module(name)
    except Exception:
        print(name, traceback.format_exc().strip().splitlines()[-1])
"""


def test_cores_are_free_of_ros(python_packages):
    modules = [
        package.module_name(source)
        for package in python_packages
        for source in package.sources()
        if 'nodes' not in source.parts
    ]
    done = subprocess.run(
        [sys.executable, '-c', IMPORT_WITHOUT_ROS, *modules],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ''


def test_only_main_prints_and_exits(python_packages):
    found = [
        f'{source}:{line}: {call}'
        for package in python_packages
        for source in package.sources()
        for line, call in calls_outside_main(ast.parse(source.read_text()))
    ]
    assert not found, 'raise a LocalizationError, log, or return the status instead'


def calls_outside_main(node: ast.AST) -> list[tuple[int, str]]:
    """Return line and name of each print and exit that is not part of a main or of `__main__`."""
    if isinstance(node, ast.FunctionDef) and node.name == 'main':
        return []
    if isinstance(node, ast.If) and '__main__' in ast.unparse(node.test):
        return []
    found = []
    if isinstance(node, ast.Call):
        name = ast.unparse(node.func)
        if name in {'print', 'exit', 'quit', 'sys.exit', 'os._exit'}:
            found.append((node.lineno, name))
    for child in ast.iter_child_nodes(node):
        found += calls_outside_main(child)
    return found


def test_files_stay_short(repository_files):
    lengths = {
        str(path): len(path.read_text().splitlines())
        for path in repository_files
        if path.suffix in CODE or path.name in {'Makefile', 'CMakeLists.txt'}
    }
    too_long = {path: lines for path, lines in lengths.items() if lines > MAX_LINES}
    assert not too_long, f'at most {MAX_LINES} lines a file: split by what changes together'


def test_no_file_names_a_folder_of_one_machine(root, repository_files):
    homes = re.compile(rf'(?<![\w.])/(?:home|Users|root)/\w|{re.escape(str(root))}\b')
    found = []
    for path in repository_files:
        try:
            text = path.read_text()
        except UnicodeDecodeError:
            continue
        found += [f'{path}: {match.group()}' for match in homes.finditer(text)]
    assert not found


def test_shell_scripts_are_valid(repository_files):
    scripts = [path for path in repository_files if is_bash(path)]
    assert scripts
    for script in scripts:
        checked = subprocess.run(
            ['bash', '-n', str(script)], capture_output=True, text=True, check=False
        )
        assert checked.returncode == 0, checked.stderr


def is_bash(path: Path) -> bool:
    """Tell whether a file starts with a bash shebang."""
    with path.open('rb') as file:
        return file.readline().startswith(b'#!/usr/bin/env bash')


@pytest.mark.parametrize('name', ['rclpy', 'lcd_msgs.msg', 'std_srvs.srv', 'tf2_msgs'])
def test_the_block_of_ros_works(name):
    done = subprocess.run(
        [sys.executable, '-c', IMPORT_WITHOUT_ROS, name],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert 'is ROS' in done.stdout
