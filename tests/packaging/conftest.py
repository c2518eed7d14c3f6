"""Find the packages of the workspace, their modules and their commands, whatever they are."""

import ast
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class PythonPackage:
    """A folder with setup.py: the arguments of its setup() call are read, not run."""

    folder: Path

    @property
    def name(self) -> str:
        """Name of the folder, of the package and of the Python package in it."""
        return self.folder.name

    def setup_argument(self, name: str) -> ast.expr:
        """Return the expression that setup() gets for an argument."""
        tree = ast.parse((self.folder / 'setup.py').read_text())
        call = next(
            node
            for node in ast.walk(tree)
            if isinstance(node, ast.Call) and ast.unparse(node.func) == 'setup'
        )
        return next(word.value for word in call.keywords if word.arg == name)

    def console_scripts(self) -> dict[str, str]:
        """Return command -> module:function."""
        lines = ast.literal_eval(self.setup_argument('entry_points'))['console_scripts']
        return dict(line.replace(' ', '').split('=') for line in lines)

    def sources(self) -> list[Path]:
        """Return every Python file of the Python package."""
        return sorted((self.folder / self.name).rglob('*.py'))

    def module_name(self, source: Path) -> str:
        """Return the dotted name under which a source file is imported."""
        parts = source.relative_to(self.folder).with_suffix('').parts
        return '.'.join(parts[:-1] if parts[-1] == '__init__' else parts)


PYTHON_PACKAGES = [PythonPackage(path.parent) for path in sorted(ROOT.glob('*/setup.py'))]


@pytest.fixture(scope='session')
def root() -> Path:
    """Folder of the repository."""
    return ROOT


@pytest.fixture(params=PYTHON_PACKAGES, ids=lambda package: package.name)
def package(request: pytest.FixtureRequest) -> PythonPackage:
    """One Python package of the workspace after the other."""
    return request.param


@pytest.fixture(scope='session')
def python_packages() -> list[PythonPackage]:
    """All Python packages of the workspace."""
    return PYTHON_PACKAGES


@pytest.fixture(scope='session')
def repository_files() -> list[Path]:
    """Every file that is, or is about to be, in the repository."""
    listing = subprocess.run(
        ['git', 'ls-files', '-z', '--cached', '--others', '--exclude-standard'],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if listing.returncode != 0:
        pytest.skip(f'git cannot list the files of {ROOT}: {listing.stderr.strip()}')
    paths = [ROOT / name for name in listing.stdout.split('\0') if name]
    return [path for path in paths if path.is_file()]
