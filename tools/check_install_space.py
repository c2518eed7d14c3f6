"""Check an install space of colcon: what `ros2 run` and other packages look for must be there."""

import importlib
import os
import sys
from importlib.metadata import Distribution, distributions
from pathlib import Path


def main() -> int:
    """Check INSTALL_SPACE PACKAGE ... and say what is missing, one line each."""
    space = Path(sys.argv[1]).resolve()
    mistakes = [line for name in sys.argv[2:] for line in check_package(space / name)]
    for line in mistakes:
        print(f'error: {line}', file=sys.stderr)
    if not mistakes:
        print(f'{space}: {", ".join(sys.argv[2:])} are complete')
    return 1 if mistakes else 0


def check_package(prefix: Path) -> list[str]:
    """Return what is wrong with a package that colcon installed to `prefix`."""
    name = prefix.name
    if not prefix.is_dir():
        return [f'{prefix} does not exist: colcon did not build {name}']
    mistakes = [
        f'{path} is missing: nothing in ROS finds {name}'
        for path in (
            prefix / 'share' / name / 'package.xml',
            prefix / 'share' / 'ament_index' / 'resource_index' / 'packages' / name,
        )
        if not path.is_file()
    ]
    for module in (name, *(f'{name}.{kind}' for kind in ('msg', 'srv') if has(prefix, kind))):
        file = importlib.import_module(module).__file__ or ''
        if not Path(file).is_relative_to(prefix):
            mistakes.append(f'{module} is imported from {file}, not from {prefix}')
    for command in console_scripts(prefix):
        executable = prefix / 'lib' / name / command
        if not os.access(executable, os.X_OK):
            mistakes.append(f'{executable} is missing: ros2 run {name} {command} finds nothing')
    return mistakes


def has(prefix: Path, kind: str) -> bool:
    """Tell whether the package installed interfaces of a kind, msg or srv."""
    return (prefix / 'share' / prefix.name / kind).is_dir()


def console_scripts(prefix: Path) -> list[str]:
    """Return the commands that the package's metadata in `prefix` declares."""
    found: list[Distribution] = list(
        distributions(path=[str(path) for path in prefix.glob('lib/python*/site-packages')])
    )
    entries = (entry for distribution in found for entry in distribution.entry_points)
    return [entry.name for entry in entries if entry.group == 'console_scripts']


if __name__ == '__main__':
    sys.exit(main())
