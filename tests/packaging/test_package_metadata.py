"""Check that colcon, pip and ROS find the same packages in the workspace."""

import ast
import configparser
import sys
from pathlib import Path

import pytest
from catkin_pkg.package import Package, parse_package

MESSAGE_SUFFIXES = ('_msgs', '_srvs', '_interfaces')


def manifests(root: Path) -> list[Package]:
    """Parse the package.xml of every package; catkin_pkg raises when one is invalid."""
    return [parse_package(str(path)) for path in sorted(root.glob('*/package.xml'))]


def test_every_manifest_is_valid_and_named_as_its_folder(root):
    found = manifests(root)
    known = {
        'lcd_common',
        'bags',
        'cmrnet_ekf',
        'lcd_loop_closure',
        'lcd_msgs',
        'uncertain_place_recognition',
    }
    assert known <= {m.name for m in found}
    for manifest in found:
        assert manifest.package_format == 3
        assert Path(manifest.filename).parent.name == manifest.name
        assert manifest.licenses == ['MIT']
        assert manifest.description.strip()


def test_the_root_is_no_package(root):
    for name in ('package.xml', 'setup.py', 'setup.cfg'):
        assert not (root / name).exists(), f'{name} at the root hides every package from colcon'


def test_packages_have_one_version(root, python_packages):
    versions = {f'{m.name}/package.xml': m.version for m in manifests(root)}
    for package in python_packages:
        version = ast.literal_eval(package.setup_argument('version'))
        versions[f'{package.name}/setup.py'] = version
    assert len(set(versions.values())) == 1, versions


def test_a_python_package_has_what_ament_expects(package):
    manifest = parse_package(str(package.folder / 'package.xml'))
    assert manifest.get_build_type() == 'ament_python'
    assert (package.folder / 'resource' / package.name).is_file()
    settings = configparser.ConfigParser(interpolation=None)
    settings.read(package.folder / 'setup.cfg')
    assert settings['develop']['script_dir'] == f'$base/lib/{package.name}'
    assert settings['install']['install_scripts'] == f'$base/lib/{package.name}'


def test_every_folder_with_python_is_a_package(package):
    folders = {source.parent for source in package.sources()}
    missing = [folder for folder in folders if not (folder / '__init__.py').is_file()]
    assert not missing, 'find_packages leaves these out of an installation'


def test_ros_dependencies_are_declared(root, package):
    manifest = parse_package(str(package.folder / 'package.xml'))
    declared = {depend.name for depend in manifest.exec_depends}
    others = {path.parent.name for path in root.glob('*/package.xml')} - {package.name}
    used = {name for source in package.sources() for name in imported_names(source)}
    needed = {
        name
        for name in used
        if name in others or name == 'rclpy' or name.endswith(MESSAGE_SUFFIXES)
    }
    assert needed <= declared, f'package.xml lacks exec_depend of {sorted(needed - declared)}'


def test_python_dependencies_are_declared(python_packages, root, package):
    """What is imported on its own (not lazily from ROS) is in install_requires and pinned."""
    own = {p.name for p in python_packages}
    required = {
        normal(name) for name in literal_strings(package.setup_argument('install_requires'))
    }
    used = {name for source in package.sources() for name in imported_names(source)}
    distributions = {
        normal(DISTRIBUTIONS.get(name, name))
        for name in used - own - set(sys.stdlib_module_names)
        if name != 'rclpy' and not name.endswith(MESSAGE_SUFFIXES)
    }
    assert distributions <= required, f'setup.py lacks {sorted(distributions - required)}'
    pinned = (root / 'requirements' / 'core.txt').read_text()
    pinned += (root / 'requirements' / 'torch.txt').read_text()
    names = {normal(line.split('==')[0]) for line in pinned.splitlines() if '==' in line}
    assert required <= names, f'requirements/core.txt lacks {sorted(required - names)}'


DISTRIBUTIONS = {
    'PIL': 'pillow',
    'mcap_ros2': 'mcap-ros2-support',
    'yaml': 'pyyaml',
}


def normal(name: str) -> str:
    return name.lower().replace('_', '-')


def literal_strings(expression: ast.expr) -> list[str]:
    return list(ast.literal_eval(expression))


def imported_names(source: Path) -> set[str]:
    """Return the top-level names of all absolute imports of a file."""
    names = set()
    for node in ast.walk(ast.parse(source.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split('.')[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names.add(node.module.split('.')[0])
    return names


@pytest.mark.ros
def test_every_interface_file_is_generated(root):
    import tf2_msgs.msg

    import lcd_msgs.msg
    import lcd_msgs.srv

    for kind, module in (('msg', lcd_msgs.msg), ('srv', lcd_msgs.srv)):
        stems = {path.stem for path in (root / 'lcd_msgs' / kind).glob(f'*.{kind}')}
        assert stems
        generated = {name for name in dir(module) if name[0].isupper() and '_' not in name}
        assert stems == generated, 'run make setup'
    assert list(tf2_msgs.msg.TFMessage.get_fields_and_field_types()) == ['transforms']
